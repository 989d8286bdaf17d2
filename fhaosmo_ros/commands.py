# SPDX-License-Identifier: Apache-2.0
"""
The package's commands, declared once: for setup.py and `python -m fhaosmo_ros`.

Import nothing heavy here: setup.py reads this file before any dependency is installed.
"""

# name: (module whose main(argv) runs it, one line of help)
COMMANDS = {
    'estimator': (
        'fhaosmo_ros.nodes.estimator.node',
        'node: estimate states and unknown input of y',
    ),
    'arm': (
        'fhaosmo_ros.nodes.arm',
        'node: estimate external torques and contacts of a robot arm',
    ),
    'calibrate': (
        'fhaosmo_ros.tools.arm.calibrate',
        'find what the URDF of an arm does not say, from free motion',
    ),
    'replay_arm': (
        'fhaosmo_ros.tools.arm.replay',
        'estimate external torques from a bag, as the node arm would',
    ),
    'plant': ('fhaosmo_ros.nodes.plant', 'node: simulate a plant and publish y and the truth'),
    'demo': (
        'fhaosmo_ros.tools.demo',
        'run plant and estimator, record, report, draw a figure',
    ),
    'record': ('fhaosmo_ros.tools.record', "record y and the estimator's topics to a bag"),
    'replay': (
        'fhaosmo_ros.tools.replay.command',
        'estimate offline from a bag, as the live node would',
    ),
    'plot': ('fhaosmo_ros.tools.plot', 'draw the estimates in bags, print their metrics'),
    'play': ('fhaosmo_ros.tools.play', "publish a bag's topics in its own time, with /clock"),
    'tune': ('fhaosmo_ros.tools.tuning.command', 'find gains that fit the sensor and the plant'),
}
