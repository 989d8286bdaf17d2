# SPDX-License-Identifier: Apache-2.0
"""
Every parameter of the package, declared once.

YAML checks, ROS descriptors, docs/parameters.md and error messages derive from these tables.
"""

from fhaosmo_ros.core.parameters.arm import ARM, ARM_NODE
from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable

MAX_ORDER = 12
CONSTANTS = 'constants.'
"""Begin of the names of constants in expressions."""
PER_LEVEL = '1 (used for every level) or one a level'

MODEL = (
    Parameter('order', 3, 'Number n of states of the triangular model.', lower=1, upper=MAX_ORDER,
              live=False),
    Parameter('phi', ['0', '0', '-z3'],
              "The functions Phi_1 .. Phi_n of z_i' = z_{i+1} + Phi_i. Phi_i may use z1 .. zi, "
              'the known inputs, the constants, numbers, pi, + - * / **, sin cos tan exp log '
              'sqrt abs tanh sign atan2 min max; at most 100 operations, 30 of them functions.',
              live=False, lengths='n (order)'),
    Parameter('inputs', ['u'],
              'Names of the known inputs that Phi may use, such as [u1, u2] or [torque]; '
              'letters, digits and _. The order is that of their columns where u is an array.',
              live=False, lengths='any'),
    Parameter('constants.NAME', 0.0,
              'The constant NAME that Phi may use, one parameter for each: constants: {m: 1.3, '
              'b: 0.4} in a file sets two.', lower=-1e100, upper=1e100),
)  # fmt: skip

OBSERVER = (
    Parameter('unknown_input', True,
              'Estimate the unknown input d as one more level (N = n + 1 levels instead of N = '
              'n; without it d is the internal state theta of level n).', live=False),
    Parameter('unknown_input_derivatives', 0,
              'Number k of derivatives of the unknown input that are estimated behind it, as '
              'further levels (N = n + 1 + k): a smooth d is followed with less lag, and noise '
              'disturbs more. Needs unknown_input.', lower=0, upper=3, live=False),
    Parameter('unknown_input_decay', 0.0,
              "Rate kappa of the observer's model of the unknown input, d' = -kappa d + what the "
              'innovations say; 0 assumes nothing. Greater where d comes and goes around 0: the '
              'estimate follows noise less, but is too small where d stays. Explicit: below 2 / '
              'dt.', unit='1/s', lower=0.0, upper=1e3),
    Parameter('gains', 'fixed',
              'fixed: those below. self_tuning: none; many observers run side by side and are '
              'weighted by how well they predict y, so that noise, size and speed of d are found '
              'and followed. Of the parameters from structure to gamma_leakage it uses '
              'prediction_step alone. The default gains are for the default phi, that of the '
              "paper's plant.", choices=('fixed', 'self_tuning'), live=False),
    Parameter('bandwidth', 1.0,
              'self_tuning: factor on the bandwidth that it would choose. Higher: quicker and '
              'noisier.', lower=0.1, upper=10.0),
    Parameter('tuning_memory', 0.0,
              'self_tuning: how long a sample counts in the choice of the observers. 0: for the '
              'time of 8000 samples.', unit='s', lower=0.0, upper=1e12),
    Parameter('structure', 'cascade',
              "cascade: the paper's levels, each with an innovation of its own. levant: Levant's "
              'arbitrary-order differentiator, every level driven by y - z_hat_1; it needs '
              'unknown_input and other gains than the cascade (docs/mathematics.md).',
              choices=('cascade', 'levant')),
    Parameter('variant', 'fuzzy_adaptive',
              'sign: discontinuous injection, gamma = 1/2. fuzzy: fuzzy curve instead of sign. '
              'sign_adaptive, fuzzy_adaptive: the same with adapted gamma; with levant gamma '
              'stays gamma_initial.',
              choices=('sign', 'fuzzy', 'fuzzy_adaptive', 'sign_adaptive')),
    Parameter('scheme', 'implicit',
              'explicit (cascade only): forward Euler (the paper). implicit: backward Euler, '
              'without the chatter that a digital step makes. predict_correct (levant only): the '
              'model is followed to the new sample by Runge-Kutta steps, then corrected as '
              'implicit does.', choices=('explicit', 'implicit', 'predict_correct')),
    Parameter('prediction_step', 0.0,
              'Longest Runge-Kutta step of predict_correct and of self_tuning; a longer interval '
              "takes several. Well below 1 / rate of the model's fastest motion; 0: a tenth of "
              'that at z = 0.', unit='s', lower=0.0, upper=1e12),
    Parameter('correction_period', 0.0,
              'predict_correct: a sample corrects as if it stood for at most this time, usually '
              'the sampling period, so that after a gap one noisy sample weighs no more than any '
              'other. 0: it stands for all the time since the one before.', unit='s', lower=0.0,
              upper=10.0),
    Parameter('noise_size', 0.0,
              'Standard deviation of the noise on y. With it cascade starts as a Kalman filter '
              'does. predict_correct, if correction_period is given, too, knows how sure it is: '
              'at the start, and where samples come at another rate, the gains are those of a '
              'Kalman filter; unlikely samples are rejected, and y that stays unlikely counts as '
              'lost. 0: not known.', lower=0.0, upper=1e12),
    Parameter('state_sizes', [0.0],
              'RMS values of z_1 .. z_n in usual operation: how far off a fresh observer may be. '
              'Used with noise_size. 0: what size and rate of d make of them.', lower=0.0,
              upper=1e100, lengths='1 (used for every state) or n'),
    Parameter('unknown_input_size', 1.0,
              'RMS value of d in usual operation. Used with noise_size.', lower=1e-12, upper=1e12),
    Parameter('unknown_input_rate', 1.0,
              'How fast d changes, where unknown_input_decay is 0. Used with noise_size.',
              unit='1/s', lower=1e-6, upper=1e6),
    Parameter('lambda', [1.4, 7.2, 6.4, 2.0],
              'Correction factors lambda_i of the injection: |eps_i|^gamma psi_i(eps_i); levant: '
              '|eps_1|^(2 gamma (N - i) / N) psi_i(eps_1).', lower=0.0, lower_open=True,
              upper=1e30, lengths=PER_LEVEL),
    Parameter('alpha', [2.1, 5.3, 0.9, 0.0014],
              'Gains alpha_i of the internal states. Not used by levant, which has none.',
              lower=0.0, lower_open=True, upper=1e30, lengths=PER_LEVEL),
    Parameter('epsilon', 0.05,
              'A level runs while |eps_j| <= epsilon for every level j before it (unit of y, and '
              'of the derivatives for the later levels). With levant all levels run: only '
              'divergence_time goes by it, and without noise_size alone.', lower=0.0,
              lower_open=True, upper=1e12),
    Parameter('fuzzy_widths', [1.5e-6, 0.035],
              'Half-widths of the fuzzy input universes of levels 1, 2, ...; the last one serves '
              'the levels that follow. Beyond its half-width psi is +-1. In the unit of the '
              'innovation eps_i; levant: of y at every level.', lower=1e-12, upper=1e12,
              lengths='1 to N; the last one serves the levels that follow'),
    Parameter('fuzzy_systems', ['terms 5', 'terms 7'],
              'The fuzzy systems of levels 1, 2, ...: terms, peaks and shapes of their '
              'membership functions, rules and defuzzifier, or a sampled curve '
              '(docs/mathematics.md, Fuzzy curves). A curve that is not odd, falls, or stays 0 '
              'is refused.', lengths='1 to N; the last one serves the levels that follow'),
    Parameter('gamma_initial', 0.95, 'Power gamma at the start of an adaptive variant.', lower=0.0,
              lower_open=True, upper=1.0),
    Parameter('gamma_rate', 0.004,
              "Learning rate Gamma of gamma' = -Gamma dL/dgamma; 0 holds gamma.", lower=0.0,
              upper=1e6),
    Parameter('gamma_min', 0.1, 'Lower bound of gamma, not above gamma_max.', lower=0.0,
              lower_open=True, upper=1.0),
    Parameter('gamma_max', 1.0, 'Upper bound of gamma.', lower=0.0, lower_open=True, upper=1.0),
    Parameter('gamma_dead_zone', 0.2,
              'Adaptation rests while the norm of the innovations is at most this (their unit; '
              'set it below the norm at which the estimate has become good enough). 0: it never '
              'rests.', lower=0.0, upper=1e12),
    Parameter('gamma_leakage', 0.01,
              'Rate at which gamma goes back to gamma_initial within the dead zone (without one: '
              'always). 0 for none.', unit='1/s', lower=0.0, upper=1e3),
    Parameter('initial_estimate', [0.0], 'Filtered estimates z_hat_1 .. z_hat_N at the start.',
              lower=-1e12, upper=1e12, lengths=PER_LEVEL),
    Parameter('initial_internal', [0.0],
              'Internal states z_tilde_2 .. z_tilde_{N+1} at the start (the last one is theta). '
              'Not used by levant, which has none.', lower=-1e12, upper=1e12, lengths=PER_LEVEL),
    Parameter('start_from_measurement', True,
              'Start z_hat_1 at the first sample of y instead of at initial_estimate[0].'),
    Parameter('estimate_from', 'internal',
              'Which variables are the published estimates of z_2 .. z_n and d: internal '
              '(z_tilde, no lag) or filtered (z_hat, smoother). z_1 is always z_hat_1. The same '
              'for levant, which has only z_hat.', choices=('internal', 'filtered')),
)  # fmt: skip

SAMPLING = (
    Parameter('sampling', 'source_stamp',
              'Sampling period of y: from the stamps of its messages (input_stamp says which), '
              'from the node clock at reception (the choice with use_sim_time where messages '
              'have no header), or nominal_period.', choices=('source_stamp', 'clock', 'nominal')),
    Parameter('nominal_period', 0.001, 'Sampling period with sampling = nominal.', unit='s',
              lower=1e-6, upper=10.0),
    Parameter('max_gap', 0.0,
              'A longer time between two usable samples, or a stamp that lies further back, '
              'restarts the observer from the new samples, once a second one confirms the jump. '
              '0: the time of 500 samples; the node says that y is silent after 0.5 s, or 5 '
              'samples. An interval of more than twice the mean, up to this, is bridged: y in '
              'between is predicted by the model and bent to the new sample.',
              unit='s', lower=0.0, upper=1e6),
    Parameter('spike_gate', 0.0,
              'A sample that lies further than this from what the model predicts from the one '
              'before is rejected (unit of y), five in a row at most: the next one is believed, '
              'a step of y is not a spike. 0 for no gate.', lower=0.0, upper=1e12),
    Parameter('stuck_time', 0.0,
              'Samples are rejected while y has not changed at all for longer than this; 0 for '
              'never.', unit='s', lower=0.0, upper=3600.0),
    Parameter('divergence_time', 1.0,
              '|eps_1| above epsilon, or steps that leave the finite numbers, for longer than '
              'this: the observer has lost y and starts afresh from it; 0 for never.', unit='s',
              lower=0.0, upper=3600.0),
    Parameter('divergence_limit', 1e60,
              'A sample of larger magnitude is rejected, and an observer with a larger state '
              'starts afresh from y.', lower=1.0, upper=1e100),
    Parameter('measurement_delay', 0.0,
              'How long before its stamp y was measured: a sample, and the estimate after it, '
              'tell of the time stamp - measurement_delay.', unit='s', lower=0.0, upper=10.0,
              live=False),
    Parameter('input_delay', 0.0,
              'The same of the known inputs, at most measurement_delay: 0 for a command that '
              'acts at once, measurement_delay for a measured one that comes in the message of '
              'y.', unit='s', lower=0.0, upper=10.0, live=False),
    Parameter('predict_to_now', False,
              'Carry what is published over measurement_delay by the model, with the known '
              'inputs since then and the present d (which follows unknown_input_decay and '
              '_derivatives).'),
    Parameter('smoothing_lag', 0.0,
              'Estimate each time from the samples before it and for so long after it: less '
              'noise, known so much later, and stamped with the time that it tells of. Fixed '
              'gains need noise_size. 0: off.', unit='s', lower=0.0, upper=60.0, live=False),
)  # fmt: skip

EVENTS = (
    Parameter('event_threshold', 0.0,
              'An event begins where |d|, or its change (event_change_time), exceeds this, and '
              'event_deviations where that is set too (unit of d). 0: no threshold; no events '
              'where event_deviations is 0 as well.', lower=0.0, upper=1e12),
    Parameter('event_deviations', 0.0,
              'An event begins where |d|, or its change, exceeds so many of its standard '
              'deviations. Needs gains = self_tuning, which knows them. 0: not used.', lower=0.0,
              upper=100.0),
    Parameter('event_duration', 0.05,
              'It begins only once that has lasted for so long without a break: longer means '
              'fewer false alarms, and later ones.', unit='s', lower=0.0, upper=3600.0),
    Parameter('event_release', 0.5,
              'It ends below this part of what it has to exceed (hysteresis).', lower=0.0,
              upper=1.0),
    Parameter('event_change_time', 0.0,
              '0: |d| is judged. Else its change: how far d lies from its running mean over '
              'about this time, once that is known. For a d that is never 0, such as friction or '
              'an error of Phi.', unit='s', lower=0.0, upper=1e6),
)  # fmt: skip

INPUT = (
    Parameter('input_topic', '', "Topic of the measured output y. '': y, or NAME/y in a channel.",
              live=False),
    Parameter('input_type', '',
              "Message type of that topic, such as sensor_msgs/msg/JointState. '': that of its "
              'publisher; std_msgs/msg/Float64 where input_topic and input_field are not set '
              'either.', live=False),
    Parameter('input_field', '',
              'The number in its messages that is y: angular_velocity.z, position[0] (by index), '
              'position[elbow] (by the name beside it, wherever it stands), '
              'pose.pose.orientation.yaw (roll, pitch, yaw of a quaternion, continuous over '
              'whole turns). In a channel, a list without index, such as position, means the '
              "element with the channel's name. '': the only number, or data; position of a "
              'JointState in a channel.', live=False),
    Parameter('input_stamp', 'auto',
              'Which stamp of a message is the time of its sample: header (when it was '
              'measured), source (when it was published), reception (when it arrived here). '
              'auto: header where the message has one, else source.',
              choices=('auto', 'header', 'source', 'reception'), live=False),
    Parameter('known_input_topics', [''],
              "Topic of each known input. '': u (or its own name); in a channel NAME/u.",
              live=False, lengths='1 (used for every known input) or one each'),
    Parameter('known_input_types', [''], 'Their message types, as input_type.', live=False,
              lengths='1 (used for every known input) or one each'),
    Parameter('known_input_fields', [''],
              'The numbers in their messages, as input_field: effort[elbow], also of the same '
              'message as y.', live=False, lengths='1 (used for every known input) or one each'),
    Parameter('known_input_stamps', ['reception'],
              'From when on each of them holds. reception: from when it arrives; one of the same '
              'message as y is that of its sample. header: a sample gets the newest one whose '
              'header stamp is not after its own, whatever arrived first; y is then read with '
              'that of its header, too.', choices=('reception', 'header'), live=False,
              lengths='1 (used for every known input) or one each'),
    Parameter('known_input_wait', 0.0,
              'How long a sample of y waits for those with known_input_stamps = header, until '
              'each has come with its stamp or a later one, by the stamps of y. Enough for the '
              'latest of them, it makes the estimates independent of the order of arrival, at '
              'the cost of that delay. For inputs that come about as often as y.', unit='s',
              lower=0.0, upper=10.0, live=False),
)  # fmt: skip

CHANNEL_OUTPUT = (
    Parameter('measurement_unit', '',
              'Unit of y, such as rad; units of the states and of d follow from it. Shown in '
              'diagnostics, descriptors and figures; nothing is converted.'),
    Parameter('unknown_input_scale', 1.0,
              'What one unit of d stands for in ~/joint_states (effort) and ~/wrench: the mass '
              'or inertia that turns an acceleration into a force or torque.', lower=-1e12,
              upper=1e12),
    Parameter('unknown_input_unit', '',
              'Unit of d times unknown_input_scale, such as N m. Shown in diagnostics.'),
    Parameter('output_axis', 'linear.x',
              'Axis of ~/wrench and ~/accel that d is written to: linear is a force or a linear '
              'acceleration, angular a torque or an angular one.',
              choices=('linear.x', 'linear.y', 'linear.z', 'angular.x', 'angular.y', 'angular.z'),
              live=False),
)  # fmt: skip

ESTIMATOR_NODE = (
    Parameter('channels', [''],
              'Names of the outputs that one process estimates from. Channel hip reads hip/y (or '
              'its own field of input_topic), publishes ~/hip/state and so on, and takes each '
              'parameter of the model, the observer, the sampling, the inputs and the units from '
              "hip.NAME where that is set, else from NAME. ['']: one channel, no prefix. "
              'from_joint_names: one for each joint of the first JointState on input_topic.',
              live=False, lengths='any'),
    Parameter('max_channels', 64,
              'Most channels that from_joint_names makes of a message; further joints are left '
              'out.', lower=1, upper=10_000, live=False),
    Parameter('autostart', True,
              'Configure and activate by itself at the start. false: wait for a lifecycle '
              'manager, or for `ros2 lifecycle set`.', live=False),
    Parameter('publish_on', 'timer',
              'timer: estimates are published at publish_rate, the latest one again where y is '
              'slower. sample: each estimate once, as soon as its sample has been used (least '
              'latency).', choices=('timer', 'sample')),
    Parameter('publish_rate', 100.0, 'Rate of the timer that publishes the estimates.', unit='Hz',
              lower=0.1, upper=5000.0),
    Parameter('typed_outputs', ['joint_states'],
              'Messages published beside the numbers, with the header stamp of the sample: '
              'joint_states (name: the channels, position: z_1, velocity: z_2, effort: d times '
              'unknown_input_scale), wrench (d times unknown_input_scale), accel (d); none. One '
              'message for all channels.', choices=('none', 'joint_states', 'wrench', 'accel'),
              live=False, lengths='any'),
    Parameter('frame_id', '', 'frame_id of these messages.', live=False),
    Parameter('input_reliability', 'best_effort',
              'QoS of the subscriptions of y and u. best_effort hears every publisher; reliable '
              'has lost samples sent again, and hears reliable publishers only.',
              choices=('best_effort', 'reliable'), live=False),
    Parameter('input_durability', 'volatile',
              'QoS of the subscriptions of y and u. transient_local also hears what was '
              'published before, of transient_local publishers only.',
              choices=('volatile', 'transient_local'), live=False),
    Parameter('input_depth', 1000,
              'Samples of y that wait while the node is busy; older ones are lost.', lower=1,
              upper=100_000, live=False),
)  # fmt: skip

DIAGNOSTICS = (
    Parameter('diagnostics_period', 1.0, 'Time between two reports on /diagnostics, in host time.',
              unit='s', lower=0.1, upper=60.0),
    Parameter('hardware_id', 'none', 'hardware_id of the reports: the sensor behind y.'),
    Parameter('warn_rate_below', 0.0, 'WARN if the sample rate of y is lower; 0 for never.',
              unit='Hz', lower=0.0, upper=1e5),
    Parameter('warn_jitter_above', 0.5,
              'WARN if the standard deviation of the sampling period over its mean is higher.',
              lower=0.0, upper=1e6),
    Parameter('warn_delay_above', 0.1,
              'WARN if a sample is taken later than this after its source stamp: this host is '
              "too slow, or its clock and the publisher's differ.", unit='s', lower=0.0,
              upper=1e6),
)  # fmt: skip

PLANT_MODEL = (
    Parameter('initial_state', [0.2], 'States z_1 .. z_n of the plant at its start.', lower=-1e12,
              upper=1e12, live=False, lengths='1 (used for every state) or n'),
    Parameter('integration_step', 1e-4,
              'Fixed step of the Runge-Kutta integration, independent of sample_rate.', unit='s',
              lower=1e-6, upper=0.1, live=False),
    Parameter('disturbance', 'sine',
              'The unknown input d(t): none (0), sine (amplitude sin(omega t) + offset), step '
              '(offset, from start on offset + amplitude), square (sign of the sine), chirp '
              '(sine whose angular frequency goes from omega to 10 omega within 20 s and stays '
              'there).', choices=('none', 'sine', 'step', 'square', 'chirp')),
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
              'Increment that y, noise included, is rounded to (unit of y), as an encoder does; '
              '0 for none.', lower=0.0, upper=1e9),
)  # fmt: skip

PLANT_NODE = (
    Parameter('sample_rate', 1000.0, 'Rate at which y and the truth are published.', unit='Hz',
              lower=0.1, upper=5000.0),
)  # fmt: skip

OBSERVER_PARAMETERS = ParameterTable(MODEL, OBSERVER)
ONLINE_PARAMETERS = ParameterTable(MODEL, OBSERVER, SAMPLING, EVENTS)
CHANNEL = (*MODEL, *OBSERVER, *SAMPLING, *EVENTS, *INPUT, *CHANNEL_OUTPUT)
CHANNEL_PARAMETERS = ParameterTable(CHANNEL)
"""What each channel of an estimator node may have for itself."""
ESTIMATOR_PARAMETERS = ParameterTable(CHANNEL, ESTIMATOR_NODE, DIAGNOSTICS)
PLANT_PARAMETERS = ParameterTable(MODEL, PLANT_MODEL)
PLANT_NODE_PARAMETERS = ParameterTable(MODEL, PLANT_MODEL, PLANT_NODE)
ARM_NODE_PARAMETERS = ParameterTable(ARM, ARM_NODE, DIAGNOSTICS[:2])
NODE_TABLES = {
    'estimator': ESTIMATOR_PARAMETERS,
    'plant': PLANT_NODE_PARAMETERS,
    'arm': ARM_NODE_PARAMETERS,
}
FIRST = (
    'order', 'phi', 'inputs', 'structure', 'variant', 'scheme', 'lambda', 'alpha', 'epsilon',
    'fuzzy_widths', 'unknown_input_decay', 'sampling', 'max_gap', 'input_topic', 'input_field',
    'channels', 'publish_on', 'publish_rate', 'disturbance', 'noise_std', 'sample_rate',
    'robot_description_file', 'measurement', 'effort', 'calibration_file', 'payload',
    'wrench_frame',
)  # fmt: skip
"""The parameters that matter first, of all nodes."""
