# SPDX-License-Identifier: Apache-2.0
"""Parameters of older versions: what stands for each of them now."""

REMOVED = {
    'fuzzy_growth': "leave it out: 'levant' has it wherever 'gamma_initial' is below 0.5",
    'fuzzy_shape': "name the shape in 'fuzzy_systems', such as 'terms gaussian 5'",
    'fuzzy_normalise': "leave it out: psi always ends at +-1; scale 'lambda' and 'alpha' instead",
    'gamma_leakage_delay': "leave it out: 'gamma_leakage' acts within the dead zone",
    'disturbance_phase': 'leave it out: waves of d begin at their offset',
    'disturbance_omega_end': "leave it out: a chirp ends at ten times 'disturbance_omega'",
    'disturbance_sweep_time': 'leave it out: a chirp sweeps for 20 s',
    'max_step': 'leave it out: intervals of more than twice the mean are bridged',
    'spike_gate_samples': "leave it out: 'spike_gate' rejects five samples in a row at most",
    'chatter_weight': "leave it out: 'tune' counts the errors alone",
    'warn_chatter_above': 'leave it out: /diagnostics says nothing of chatter',
    'error_bad_share_above': 'leave it out: ERROR if more than half of the samples were unused',
    'input_reliability': "set 'qos_overrides./TOPIC.subscription.reliability'",
    'input_durability': "set 'qos_overrides./TOPIC.subscription.durability'",
    'input_depth': "set 'qos_overrides./TOPIC.subscription.depth'",
    'divergence_limit': 'leave it out: samples beyond 1e60 are rejected',
    'sines': 'leave it out: a sum has 5 sines',
    'known_input_stamps': 'leave it out: a sample gets the u that came before it; where u is '
    "measured with y, take it from the message of y by 'known_input_fields'",
    'known_input_wait': 'leave it out: samples do not wait for known inputs',
    'search': "leave it out: 'tune' searches the model of d, or the gains where 'lambda' is set",
    'unknown_input_unit': "leave it out: ~/joint_states has d times 'unknown_input_scale'",
    'event_release': 'leave it out: an event ends below half of what it has to exceed',
    'tuning_memory': 'leave it out: a sample counts for 8000 samples',
    'unknown_input_rate': "leave it out: it is 1/s; for a quicker d raise 'unknown_input_size'",
    'gamma_max': 'leave it out: it is 1',
    'bandwidth': "leave it out: 'self_tuning' finds its bandwidth",
    'diagnostics_period': 'leave it out: reports come every second',
    'hardware_id': "leave it out: reports have 'none'",
    'warn_rate_below': 'leave it out: /diagnostics has the sample rate as a number',
    'warn_jitter_above': 'leave it out: WARN above 0.5',
    'torque_noise': 'leave it out: the noise of torques is found from the samples',
    'warn_delay_above': 'leave it out: WARN above 0.1 s',
}
"""What a message says of a name that was a parameter once."""
