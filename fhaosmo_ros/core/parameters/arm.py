# SPDX-License-Identifier: Apache-2.0
"""The parameters of an arm, each declared once."""

from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable

ARM = (
    Parameter('joints', [''],
              'Joints that are estimated, by name; others rest at zero. Empty: all that move but '
              'mimic joints and those with finger, gripper or knuckle in their name.', live=False),
    Parameter('gravity', [0.0, 0.0, -9.81], "Gravity in the base's frame.", unit='m/s^2',
              lower=-100.0, upper=100.0, live=False, lengths='3'),
    Parameter('measurement', 'position',
              'What is measured: positions, or the velocities of the message where the drive '
              'measures them better.', choices=('position', 'velocity'), live=False),
    Parameter('effort', 'torque',
              'What effort of the message is: joint torque, motor current (times '
              'torque_constants), or torque without that of gravity (as the UR driver publishes).',
              choices=('torque', 'current', 'gravity_compensated'), live=False),
    Parameter('torque_constants', [1.0],
              'Joint torque for one unit of effort; those of calibration_file count where this is '
              '1.', lower=-1e6, upper=1e6, live=False, lengths='1 or n'),
    Parameter('torque_delay', 0.0, 'Time by which effort is older than the positions beside it.',
              unit='s', lower=0.0, upper=0.1, live=False),
    Parameter('payload', [0.0, 0.0, 0.0, 0.0],
              "Mass (kg) and centre (m) of what the last link carries, in that joint's frame.",
              lower=-1e4, upper=1e4, lengths='4'),
    Parameter('calibration_file', '',
              'YAML file of `calibrate`, whose noise of positions wins; empty: the URDF alone.',
              live=False),
    Parameter('position_noise', [2e-5],
              'Standard deviation of the noise of a position, at least: a step of the encoder '
              'over the root of 12. More is found while the node runs.',
              unit='rad', lower=1e-9, upper=1.0, live=False, lengths='1 or n'),
    Parameter('velocity_noise', [1e-3],
              'Standard deviation of the noise of a velocity, at least; more is found.',
              unit='rad/s', lower=1e-9, upper=100.0, live=False, lengths='1 or n'),
    Parameter('false_alarms_per_minute', 1.0,
              'How often contact may be reported in free motion.', lower=1e-3, upper=60.0),
)  # fmt: skip

ARM_NODE = (
    Parameter('robot_description_file', '',
              'File of the URDF; empty: the topic robot_description, as robot_state_publisher '
              'latches it.', live=False),
    Parameter('input_topic', 'joint_states',
              'Topic of sensor_msgs/msg/JointState with positions and efforts.', live=False),
    Parameter('publish_rate', 250.0,
              'Most messages of each kind in a second; events are published at once.', unit='Hz',
              lower=0.1, upper=5000.0),
    Parameter('wrench_frame', '',
              'Link at whose origin, and along whose axes, ~/external_wrench is; empty: none.',
              live=False),
)  # fmt: skip

ARM_PARAMETERS = ParameterTable(ARM)
