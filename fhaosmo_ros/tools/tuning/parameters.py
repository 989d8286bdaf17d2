# SPDX-License-Identifier: Apache-2.0
"""Parameters of `tune` itself, and the table of all that it takes beside the estimator's."""

from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable
from fhaosmo_ros.core.parameters.tables import MODEL
from fhaosmo_ros.core.simulation.recordings import FAMILY, SENSOR, SHARED

TUNING = (
    Parameter(
        'recordings', 36, 'Number of recordings that the search sees.', lower=1, upper=10_000,
        live=False,
    ),
    Parameter(
        'held_out', 36, 'Number of other recordings, with other seeds, that only the report sees.',
        lower=1, upper=10_000, live=False,
    ),
    Parameter(
        'settled', 5.0, 'Errors count from this time of a recording on.', unit='s',
        lower=0.0, upper=1e5, live=False,
    ),
    Parameter(
        'weights', [1.0],
        'Weight of the error of each estimate, squared and relative to the RMS of its truth.',
        lower=0.0, upper=1e9, live=False, lengths='1 (d alone) or n + 1 (z1 .. zn, d)',
    ),
)  # fmt: skip

TUNE_PARAMETERS = ParameterTable(MODEL, SENSOR, SHARED, FAMILY, TUNING)
