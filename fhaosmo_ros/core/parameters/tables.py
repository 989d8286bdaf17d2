# SPDX-License-Identifier: Apache-2.0
"""
Every parameter of the package, declared once.

YAML checks, ROS descriptors, docs/parameters.md and error messages derive from these tables.
"""

from fhaosmo_ros.core.parameters.arm import ARM, ARM_NODE
from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable

CONSTANTS = 'constants.'
"""Begin of the names of constants in expressions."""
PER_LEVEL = '1 or N'

MODEL = (
    Parameter('order', 3, 'Number n of states of the model.', lower=1, upper=12,
              live=False),
    Parameter('phi', ['0', '0', '-z3'],
              "The functions Phi_i of z_i' = z_{i+1} + Phi_i. Phi_i may use z1 .. zi, the known "
              'inputs, the constants, numbers, pi, + - * / **, sin cos tan exp log sqrt abs '
              'tanh sign atan2 min max; at most 100 operations.',
              live=False, lengths='n (order)'),
    Parameter('inputs', ['u'],
              'Names of the known inputs that Phi may use: letters, digits and _. Columns of an '
              'array u have this order.', live=False, lengths='any'),
    Parameter('constants.NAME', 0.0,
              'The constant NAME that Phi may use: constants: {m: 1.3, b: 0.4} in a file sets '
              'two.', lower=-1e100, upper=1e100),
)  # fmt: skip

OBSERVER = (
    Parameter('unknown_input', True,
              'Estimate d as one more level (N = n + 1). Without it N = n, and d is the '
              'internal state theta of level n.', live=False),
    Parameter('unknown_input_derivatives', 0,
              'Number k of derivatives of d that are estimated as further levels (N = n + 1 + '
              'k): less lag behind a smooth d, and more noise; 0 suits a d that jumps. Needs '
              'unknown_input.', lower=0, upper=3, live=False),
    Parameter('unknown_input_decay', 0.0,
              "Rate kappa of the model d' = -kappa d + what the innovations say. Greater where "
              'd varies around 0: less noise in the estimate, which is too small where d stays. '
              'Explicit: below 2 / dt.', unit='1/s', lower=0.0, upper=1e6),
    Parameter('gains', 'fixed',
              'fixed: those below; their defaults are for the default phi. self_tuning: noise, '
              'size and speed of d are found and followed (docs/self_tuning.md). Of the '
              'parameters from structure to gamma_leakage it uses prediction_step alone.',
              choices=('fixed', 'self_tuning'), live=False),
    Parameter('structure', 'cascade',
              "cascade: the paper's levels, each with its own innovation. levant: Levant's "
              'differentiator, every level driven by y - z_hat_1; it needs unknown_input and '
              'other gains (docs/mathematics.md).', choices=('cascade', 'levant'), live=False),
    Parameter('variant', 'fuzzy_adaptive',
              'sign: discontinuous injection, gamma = 1/2. fuzzy: a fuzzy curve instead. '
              'sign_adaptive, fuzzy_adaptive: gamma adapts; with levant it stays gamma_initial.',
              choices=('sign', 'fuzzy', 'fuzzy_adaptive', 'sign_adaptive')),
    Parameter('scheme', 'implicit',
              'Of cascade. explicit: forward Euler, as in the paper. implicit: backward Euler, '
              'without the chatter of the time step. levant always predicts by Runge-Kutta steps '
              'to the new sample and then corrects: predict_correct.',
              choices=('explicit', 'implicit', 'predict_correct')),
    Parameter('prediction_step', 0.0,
              'Longest Runge-Kutta step of levant and of self_tuning. Well below 1 / '
              "rate of the model's fastest motion; 0: a tenth of that at z = 0.", unit='s',
              lower=0.0, upper=1e12),
    Parameter('correction_period', 0.0,
              'levant: a sample corrects as if it stood for at most this time, usually '
              'the sampling period, however long the gap before it. 0: for all the time since '
              'the one before.', unit='s', lower=0.0, upper=10.0),
    Parameter('noise_size', 0.0,
              'Standard deviation of the noise on y; 0: not known. With it cascade, or levant '
              'with correction_period, starts as a Kalman filter does; levant then also follows '
              'other rates, rejects unlikely samples, and notices that y is lost.', lower=0.0,
              upper=1e12),
    Parameter('state_sizes', [0.0],
              'RMS of z_1 .. z_n in usual operation: how far off a fresh observer may be. Used '
              'with noise_size. 0: what size and rate of d make of them.', lower=0.0, upper=1e100,
              lengths='1 or n'),
    Parameter('unknown_input_size', 1.0, 'RMS of d in usual operation. Used with noise_size.',
              lower=1e-12, upper=1e12),
    Parameter('lambda', [1.4, 7.2, 6.4, 2.0],
              'Gains lambda_i of the injection |eps_i|^gamma psi_i(eps_i); levant: |eps_1|^(2 '
              'gamma (N - i) / N) psi_i(eps_1). Higher: quicker and noisier.', lower=0.0,
              lower_open=True, upper=1e30, lengths=PER_LEVEL),
    Parameter('alpha', [2.1, 5.3, 0.9, 0.0014],
              'Gains alpha_i of the internal states; levant has none.', lower=0.0,
              lower_open=True, upper=1e30, lengths=PER_LEVEL),
    Parameter('epsilon', 0.05,
              'A level runs while |eps_j| <= epsilon for every level j before it (unit of y, '
              'and of its derivatives). With levant only divergence_time uses it, where '
              'noise_size is 0.', lower=0.0, lower_open=True, upper=1e12),
    Parameter('fuzzy_widths', [1.5e-6, 0.035],
              'Half-widths of the fuzzy input universes of levels 1, 2, ... Beyond its '
              'half-width psi is +-1. Unit of eps_i; levant: of y.', lower=1e-12, upper=1e12,
              lengths='1 to N; the last one serves later levels'),
    Parameter('fuzzy_systems', ['terms 5', 'terms 7'],
              'The fuzzy systems of levels 1, 2, ...: membership functions and '
              'rules, or a sampled curve (docs/mathematics.md, Fuzzy curves).',
              lengths='1 to N; the last one serves later levels'),
    Parameter('gamma_initial', 0.95, 'Power gamma at the start of an adaptive variant.', lower=0.0,
              lower_open=True, upper=1.0),
    Parameter('gamma_rate', 0.004,
              "Learning rate Gamma of gamma' = -Gamma dL/dgamma. With 0, and gamma_leakage = 0, "
              'gamma is held.', lower=0.0, upper=1e6),
    Parameter('gamma_min', 0.1, 'Lower bound of gamma; the upper one is 1.', lower=0.0,
              lower_open=True, upper=1.0),
    Parameter('gamma_dead_zone', 0.2,
              'Adaptation rests while the norm of the innovations is at most this (their unit). '
              'Set it below the norm at which the estimate is good enough. 0: it never rests.',
              lower=0.0, upper=1e12),
    Parameter('gamma_leakage', 0.01,
              'Rate at which gamma returns to gamma_initial within the dead zone (without one: '
              'always).', unit='1/s', lower=0.0, upper=1e3),
    Parameter('initial_estimate', [0.0], 'Filtered estimates z_hat_1 .. z_hat_N at the start.',
              lower=-1e12, upper=1e12, lengths=PER_LEVEL),
    Parameter('initial_internal', [0.0],
              'Internal states z_tilde_2 .. z_tilde_{N+1} (theta) at the start; levant has '
              'none.', lower=-1e12, upper=1e12, lengths=PER_LEVEL),
    Parameter('start_from_measurement', True,
              'Start z_hat_1 at the first sample of y instead of at initial_estimate[0].'),
    Parameter('estimate_from', 'internal',
              'What is published as z_2 .. z_n and d: internal (z_tilde, no lag) or filtered '
              '(z_hat, smoother; levant has only this).', choices=('internal', 'filtered')),
)  # fmt: skip

SAMPLING = (
    Parameter('sampling', 'source_stamp',
              'Sampling period of y: from the stamps of its messages (input_stamp), from the '
              'node clock at reception (the choice with use_sim_time where messages have no '
              'header), or nominal_period.', choices=('source_stamp', 'clock', 'nominal')),
    Parameter('nominal_period', 0.001, 'Sampling period with sampling = nominal.', unit='s',
              lower=1e-6, upper=10.0),
    Parameter('max_gap', 0.0,
              'A longer time between two usable samples, or a stamp further back, restarts the '
              'observer; a shorter gap is bridged (docs/node.md, Time). 0: the time of 500 '
              'samples, but y counts as silent after 0.5 s, or 5 samples.', unit='s', lower=0.0,
              upper=1e6),
    Parameter('spike_gate', 0.0,
              'A sample further than this from its prediction is rejected (unit of y), five in '
              'a row at most. 0: no gate.', lower=0.0, upper=1e12),
    Parameter('stuck_time', 0.0,
              'Samples are rejected while y has not changed at all for longer than this. 0: '
              'never.', unit='s', lower=0.0, upper=3600.0),
    Parameter('divergence_time', 1.0,
              '|eps_1| above epsilon, or steps that fail, for longer than this: y is lost, and '
              'the observer starts afresh. 0: never.', unit='s', lower=0.0, upper=3600.0),
    Parameter('measurement_delay', 0.0,
              'How long before its stamp y was measured; estimates belong to the time stamp - '
              'measurement_delay.', unit='s', lower=0.0, upper=10.0, live=False),
    Parameter('input_delay', 0.0,
              'The same of the known inputs, at most measurement_delay: 0 for a command that '
              'acts at once, measurement_delay for one that is measured with y.', unit='s',
              lower=0.0, upper=10.0, live=False),
    Parameter('predict_to_now', False,
              'Carry what is published over measurement_delay by the models of z and d, with '
              'the known inputs since then.'),
    Parameter('smoothing_lag', 0.0,
              'Estimate each time from the samples before it and for so long after it; the '
              'stamp is that time. Fixed gains need noise_size. 0: off.', unit='s', lower=0.0,
              upper=60.0, live=False),
)  # fmt: skip

EVENTS = (
    Parameter('event_threshold', 0.0,
              'An event begins where |d| exceeds this (unit of d), and event_deviations where '
              'that is set too. 0: no threshold; no events where both are 0.', lower=0.0,
              upper=1e12),
    Parameter('event_deviations', 0.0,
              'An event begins where |d| exceeds so many of its standard deviations, which only '
              'self_tuning knows. 0: not used.', lower=0.0, upper=100.0),
    Parameter('event_duration', 0.05,
              'An event begins only after so long without a break: longer means fewer false '
              'alarms, and later ones.', unit='s', lower=0.0, upper=3600.0),
    Parameter('event_change_time', 0.0,
              '> 0: not |d| is judged, but how far d lies from its running mean over about this '
              'time. For a d that is never 0, such as friction or an error of Phi.', unit='s',
              lower=0.0, upper=1e6),
)  # fmt: skip

INPUT = (
    Parameter('input_topic', '', "Topic of the measured output y. '': y, or NAME/y in a channel.",
              live=False),
    Parameter('input_type', '',
              "Its message type, such as sensor_msgs/msg/JointState. '': the publisher's; "
              'std_msgs/msg/Float64 where input_topic and input_field are not set either.',
              live=False),
    Parameter('input_field', '',
              'The number in its messages that is y, such as position[elbow] or '
              "angular_velocity.z (docs/node.md, Any message). '': the only number, or data; "
              'position of a JointState in a channel.', live=False),
    Parameter('input_stamp', 'auto',
              'Which stamp is the time of a sample: header (when it was measured), source (when '
              'published), reception (when it arrived here). auto: header where there is one, '
              'else source.', choices=('auto', 'header', 'source', 'reception'), live=False),
    Parameter('known_input_topics', [''],
              "Topic of each known input. '': u (or its own name); in a channel NAME/u.",
              live=False, lengths='1 (for all) or one each'),
    Parameter('known_input_types', [''], 'Their message types, as input_type.', live=False,
              lengths='1 (for all) or one each'),
    Parameter('known_input_fields', [''],
              'The numbers in their messages, as input_field. One of the message of y is that of '
              'its sample; of another message a sample gets the latest one that has arrived.',
              live=False, lengths='1 (for all) or one each'),
)  # fmt: skip

CHANNEL_OUTPUT = (
    Parameter('measurement_unit', '',
              'Unit of y, such as rad; those of the states and of d follow from it. Shown in '
              'diagnostics and figures; nothing is converted.'),
    Parameter('unknown_input_scale', 1.0,
              'What one unit of d stands for in ~/joint_states (effort) and ~/wrench: the mass '
              'or inertia.', lower=-1e12, upper=1e12),
    Parameter('output_axis', 'linear.x', 'Axis of ~/wrench and ~/accel that d is written to.',
              choices=('linear.x', 'linear.y', 'linear.z', 'angular.x', 'angular.y', 'angular.z'),
              live=False),
)  # fmt: skip

ESTIMATOR_NODE = (
    Parameter('channels', [''],
              'Names of the outputs that one process estimates from (docs/node.md, Many '
              "channels). ['']: one, without prefix. from_joint_names: one for each joint of "
              'the first JointState on input_topic.', live=False, lengths='any'),
    Parameter('max_channels', 64,
              'Most channels that from_joint_names makes; further joints are left out.', lower=1,
              upper=10_000, live=False),
    Parameter('autostart', True,
              'Configure and activate at the start. false: wait for a lifecycle manager, or for '
              '`ros2 lifecycle set`.', live=False),
    Parameter('publish_on', 'timer',
              'timer: the latest estimate at publish_rate, again where y is slower. sample: '
              'each estimate once, as soon as its sample has been used.',
              choices=('timer', 'sample')),
    Parameter('publish_rate', 100.0, 'Rate of the timer that publishes the estimates.', unit='Hz',
              lower=0.1, upper=5000.0),
    Parameter('typed_outputs', ['joint_states'],
              'Messages beside the numbers, with the header stamp of the sample, one for all '
              'channels: joint_states, wrench, accel (docs/node.md says what is in them); none.',
              choices=('none', 'joint_states', 'wrench', 'accel'), live=False, lengths='any'),
    Parameter('frame_id', '', 'frame_id of these messages.', live=False),
)  # fmt: skip

PLANT_MODEL = (
    Parameter('initial_state', [0.2], 'States z_1 .. z_n at the start.', lower=-1e12, upper=1e12,
              live=False, lengths='1 or n'),
    Parameter('integration_step', 1e-4, 'Longest step of the Runge-Kutta integration.', unit='s',
              lower=1e-6, upper=0.1, live=False),
    Parameter('disturbance', 'sine',
              'The unknown input d(t): none (0), sine (amplitude sin(omega t) + offset), step '
              '(offset, from start on offset + amplitude), square (sign of the sine), chirp (a '
              'sine from omega to 10 omega within 20 s, which then stays).',
              choices=('none', 'sine', 'step', 'square', 'chirp')),
    Parameter('disturbance_amplitude', 0.1, 'Amplitude of d.', lower=-1e9, upper=1e9),
    Parameter('disturbance_omega', 1.0, 'Angular frequency of d.', unit='rad/s', lower=0.0,
              upper=1e5),
    Parameter('disturbance_offset', 0.0, 'Constant part of d.', lower=-1e9, upper=1e9),
    Parameter('disturbance_start', 1.0, 'Time of the step.', unit='s', lower=0.0, upper=1e9),
    Parameter('noise_std', 0.0, 'Standard deviation of the white Gaussian noise on y (unit of y).',
              lower=0.0, upper=1e9),
    Parameter('noise_seed', 1, 'Seed of the noise; setting it starts the noise sequence again.',
              lower=0, upper=2**31 - 1),
    Parameter('quantisation', 0.0,
              'Step that y, noise included, is rounded to (unit of y), as by an encoder. 0: '
              'none.', lower=0.0, upper=1e9),
)  # fmt: skip

PLANT_NODE = (
    Parameter('sample_rate', 1000.0, 'Rate at which y and the truth are published.', unit='Hz',
              lower=0.1, upper=5000.0),
)  # fmt: skip

OBSERVER_PARAMETERS = ParameterTable(MODEL, OBSERVER)
ONLINE_PARAMETERS = ParameterTable(MODEL, OBSERVER, SAMPLING, EVENTS)
CHANNEL_PARAMETERS = ParameterTable(MODEL, OBSERVER, SAMPLING, EVENTS, INPUT, CHANNEL_OUTPUT)
"""What each channel of an estimator node may have for itself."""
ESTIMATOR_PARAMETERS = ParameterTable(CHANNEL_PARAMETERS.declared, ESTIMATOR_NODE)
PLANT_PARAMETERS = ParameterTable(MODEL, PLANT_MODEL)
PLANT_NODE_PARAMETERS = ParameterTable(MODEL, PLANT_MODEL, PLANT_NODE)
ARM_NODE_PARAMETERS = ParameterTable(ARM, ARM_NODE)
NODE_TABLES = {
    'estimator': ESTIMATOR_PARAMETERS,
    'plant': PLANT_NODE_PARAMETERS,
    'arm': ARM_NODE_PARAMETERS,
}
