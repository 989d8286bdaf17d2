# SPDX-License-Identifier: Apache-2.0
"""
The package's commands, declared once: for `ros2 run` (setup.py) and `python -m fhaosmo_ros`.

Import nothing heavy here: setup.py reads this file before any dependency is installed.
"""

# name: (module whose main(argv) runs it, one line of help)
COMMANDS = {
    'estimator': ('fhaosmo_ros.nodes.estimator', 'node: estimate states and unknown input of y'),
    'plant': ('fhaosmo_ros.nodes.plant', 'node: simulate a plant and publish y and the truth'),
    'demo': ('fhaosmo_ros.tools.demo', 'run plant and estimator, record, report, draw a figure'),
    'record': ('fhaosmo_ros.tools.record', "record y and the estimator's topics to a bag"),
    'replay': ('fhaosmo_ros.tools.replay', 'estimate offline from a bag, as the live node would'),
    'plot': ('fhaosmo_ros.tools.plot', 'draw the estimates in bags, print their metrics'),
    'play': ('fhaosmo_ros.tools.play', "publish a bag's topics in its own time, with /clock"),
    'tune': ('fhaosmo_ros.tools.tuning.command', 'find gains that fit the sensor and the plant'),
    'compare': (
        'fhaosmo_ros.tools.comparison.command',
        'compare with other observers, all tuned alike',
    ),
    'paper': ('fhaosmo_ros.tools.paper', "reproduce the paper's figures and judge its findings"),
}
