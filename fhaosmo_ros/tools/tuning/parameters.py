# SPDX-License-Identifier: Apache-2.0
"""Parameters of `tune` itself, and the table of all that it takes beside the estimator's."""

from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable
from fhaosmo_ros.core.parameters.tables import MODEL
from fhaosmo_ros.core.simulation.recording_parameters import FAMILY, SENSOR, SHARED

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
    Parameter(
        'chatter_weight', 0.02,
        'Added to the objective for every tenfold of the chatter of d (total variation of the '
        'estimate over that of d).',
        lower=0.0, upper=1e6, live=False,
    ),
    Parameter(
        'settling_weight', 0.05,
        'Added to the objective for an estimate of d that needs all of `settled` to come within '
        'settling_band; in proportion for one that needs less.',
        lower=0.0, upper=1e6, live=False,
    ),
    Parameter(
        'settling_band', 1.0, 'In RMS of d; see settling_weight.', lower=0.0, lower_open=True,
        upper=1e6, live=False,
    ),
    Parameter(
        'search',
        [
            'lambda', 'alpha', 'fuzzy_widths', 'epsilon', 'gamma_initial',
            'unknown_input_decay',
        ],
        'Parameters of the estimator to search, each "NAME" or "NAME LOW HIGH", in logarithms '
        'where their scale is open and linearly where they lie between 0 and 1 ("NAME LOW HIGH '
        'log" or "... linear" says otherwise). A list is searched level by level. A parameter '
        'that variant or structure do not use is passed over.',
        live=False, lengths='1 or more',
    ),
    Parameter(
        'decades', 0.0,
        'Bounds of a search in logarithms, where none are given: powers of ten around its start. '
        "0: 0.5 around a Kalman filter's gains (docs/offline.md), 3 around others.",
        lower=0.0, upper=12.0, live=False,
    ),
)  # fmt: skip

TUNE_PARAMETERS = ParameterTable(MODEL, SENSOR, SHARED, FAMILY, TUNING)
