# SPDX-License-Identifier: Apache-2.0
"""
The package's commands, declared once: for setup.py and `python -m fhaosmo_ros`.

Import nothing heavy here: setup.py reads this file before any dependency is installed.
"""

# name: (module of the package whose main(argv) runs it, one line of help)
COMMANDS = {
    'estimator': ('.nodes.estimator.node', 'node: estimate states and unknown input of y'),
    'arm': ('.nodes.arm', 'node: estimate external torques and contacts of a robot arm'),
    'calibrate': ('.tools.arm.calibrate', 'find what the URDF of an arm lacks, from free motion'),
    'replay_arm': ('.tools.arm.replay', 'estimate external torques from a bag, as arm would'),
    'plant': ('.nodes.plant', 'node: simulate a plant and publish y and the truth'),
    'demo': ('.tools.demo', 'run plant and estimator, record, report, draw a figure'),
    'record': ('.tools.record', "record y and the estimator's topics to a bag"),
    'replay': ('.tools.replay.command', 'estimate offline from a bag, as the live node would'),
    'plot': ('.tools.plot', 'draw the estimates in bags, print their metrics'),
    'play': ('.tools.play', "publish a bag's topics in its own time, with /clock"),
    'tune': ('.tools.tuning.command', 'find gains that fit the sensor and the plant'),
}
