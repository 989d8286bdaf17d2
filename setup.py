# SPDX-License-Identifier: Apache-2.0
"""
Build script of the ROS 2 package: colcon, pip and scripts/environment.sh read it.

colcon runs the commands `install` and `develop`; setup.cfg sends their scripts to lib/fhaosmo_ros,
where `ros2 run` looks for executables: one for each command. pip builds a wheel, whose scripts go
to bin, on everybody's PATH: there `record`, `play`, `plot` and others would hide programs of the
same name (sox and ImageMagick have some), so a wheel has one script, `fhaosmo COMMAND`.
"""

from pathlib import Path
import sys

from fhaosmo_ros import __version__
from fhaosmo_ros.commands import COMMANDS
from setuptools import find_packages, setup

NAME = 'fhaosmo_ros'
FOR_ROS2_RUN = bool({'install', 'develop'} & set(sys.argv))
CHECK = ['hypothesis', 'pytest', 'pytest-rerunfailures', 'pytest-xdist']
TUNE = ['cmaes', 'control', 'optuna>=4,<6']
DOCS = ['myst-parser', 'sphinx', 'sphinx-rtd-theme']


def wheels(distribution):
    """Return what the nodes need of a ROS distribution, as wheels."""
    packages = (
        'builtin-interfaces', 'diagnostic-msgs', 'geometry-msgs', 'lifecycle-msgs',
        'rcl-interfaces', 'rclpy', 'rmw-fastrtps-cpp', 'rosgraph-msgs', 'sensor-msgs',
        'std-msgs', 'std-srvs',
    )  # fmt: skip
    return [f'ros-{distribution}-{package}' for package in packages]


def files(*patterns):
    """List the files of this folder that match, grouped under share/ as they lie here."""
    groups = {}
    for pattern in patterns:
        for path in sorted(Path().glob(pattern)):
            groups.setdefault(f'share/{NAME}/{path.parent}', []).append(str(path))
    return list(groups.items())


setup(
    name=NAME,
    version=__version__,
    description='States and unknown input of a system from one measured output, live on ROS 2.',
    maintainer='fhaosmo_ros maintainers',
    maintainer_email='fhaosmo_ros@example.org',
    license='Apache-2.0',
    python_requires='>=3.10',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *files(
            'config/**/*.yaml',
            'config/*.xml',
            'launch/*.py',
            'docs/*.md',
            'docs/*.png',
            'docs/*.svg',
        ),
    ],
    zip_safe=False,
    install_requires=[
        'matplotlib',
        'networkx',  # this, packaging and scipy: scikit-fuzzy imports them but declares nothing
        'numba',
        'numpy',
        'orjson',
        'packaging',
        'pyyaml',
        'rosbags>=0.11.9,<0.12',  # tools/bags uses its internals
        'scikit-fuzzy',
        'scipy',
        'setuptools',
        'tqdm',
    ],
    # Not tests_require: colcon then finds no tests.
    extras_require={
        'differentiate': ['cvxpy', 'pynumdiff>=0.3'],
        'docs': DOCS,
        'recipes': ['rotorpy>=3,<4'],  # a simulator of drones, for studies/recipes
        # Community builds, for machines without ROS. Never beside an installed ROS.
        **{f'ros-{distribution}': wheels(distribution) for distribution in ('jazzy', 'kilted')},
        'tune': TUNE,
        'compare': TUNE,
        'check': CHECK,
        'test': [
            *CHECK,
            *DOCS,
            *TUNE,
            'colcon-common-extensions',
            'import-linter',
            'mcap',
            'mcap-ros2-support',
            'mypy',
            'ruff',
            'selenium',  # with chromium and its driver, where they are installed
            'setuptools>=68,<80',  # from 80 on, colcon build --symlink-install silently copies
            'sympy',
            'types-PyYAML',
        ],
    },
    # Not the main of a command's module: importing that takes a second, and a signal during it
    # must end the command too.
    entry_points={
        'console_scripts': [f'{command} = {NAME}.__main__:{command}' for command in COMMANDS]
        if FOR_ROS2_RUN
        else [f'fhaosmo = {NAME}.__main__:main'],
    },
)
