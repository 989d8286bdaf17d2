# SPDX-License-Identifier: Apache-2.0
"""Parameters of a family of recordings, declared once; see recordings.py."""

from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable
from fhaosmo_ros.core.parameters.tables import MODEL, ONLINE_PARAMETERS, PLANT_NODE_PARAMETERS

SHAPES = ('sines', 'steps', 'chirp')

SHARED = tuple(
    PLANT_NODE_PARAMETERS[name]
    for name in (
        'initial_state', 'integration_step', 'noise_std', 'noise_seed', 'quantisation',
        'sample_rate',
    )
)  # fmt: skip
"""A plant's YAML describes these for its family, too."""
SENSOR = (ONLINE_PARAMETERS['measurement_delay'],)
"""An estimator's YAML describes this."""

FAMILY = (
    Parameter('duration', 20.0, 'Length of a recording.', unit='s', lower=0.1, upper=1e5,
              live=False),
    Parameter('disturbances', ['sines', 'steps', 'chirp'],
              'Shapes of d, taken in turn: sines (a sum with random frequencies in band_of_d, '
              'phases and amplitudes), steps (random levels at random times), chirp (through '
              'band_of_d, upwards or downwards). Never one sine: gains tuned on it would '
              'resonate at it.', choices=SHAPES, live=False, lengths='1 or more'),
    Parameter('rms_of_d', 0.07, 'RMS of d in each recording.', lower=0.0, lower_open=True,
              upper=1e9, live=False),
    Parameter('band_of_d', [0.5, 8.0], 'Lowest and highest angular frequency of sines and chirp.',
              unit='rad/s', lower=0.0, lower_open=True, upper=1e5, live=False, lengths='2'),
    Parameter('sines', 5, 'Number of sines in a sum.', lower=2, upper=1000, live=False),
    Parameter('step_interval', 3.0, 'Mean time between two steps, at least a third of it.',
              unit='s', lower=1e-3, upper=1e5, live=False),
    Parameter('rms_of_u', 1.0,
              'RMS of the known input, sines in band_of_d as well, where the model uses u.',
              lower=0.0, upper=1e9, live=False),
    Parameter('period_jitter', 0.0,
              'Standard deviation of the moments of sampling about the even grid; the stamps '
              'tell.', unit='s', lower=0.0, upper=10.0, live=False),
    Parameter('stamp_jitter', 0.0,
              'Standard deviation of the stamps about the moments of sampling; nothing tells.',
              unit='s', lower=0.0, upper=10.0, live=False),
    Parameter('dropout', 0.0, 'Share of the samples that are lost.', lower=0.0, upper=0.9,
              live=False),
    Parameter('dropout_length', 1.0, 'Mean number of samples that are lost one after the other.',
              lower=1.0, upper=1e6, live=False),
    Parameter('outliers', 0.0, 'Share of the samples that are outliers.', lower=0.0, upper=1.0,
              live=False),
    Parameter('outlier_std', 1.0,
              'Standard deviation of what an outlier adds to the noise of its sample (unit of '
              'y).', lower=0.0, upper=1e9, live=False),
)  # fmt: skip

FAMILY_PARAMETERS = ParameterTable(MODEL, SENSOR, SHARED, FAMILY)
