# SPDX-License-Identifier: Apache-2.0
"""Build script of the ROS 2 package: colcon and scripts/environment.sh both read it."""

from pathlib import Path

from fhaosmo_ros import __version__
from fhaosmo_ros.commands import COMMANDS
from setuptools import find_packages, setup

NAME = 'fhaosmo_ros'
TUNE = ['cmaes', 'control', 'optuna>=4,<6']


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
    python_requires='>=3.11',
    packages=find_packages(exclude=['test', 'test.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *files('config/**/*.yaml', 'config/*.xml', 'launch/*.py'),
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
        'rosbags>=0.11.9,<0.12',  # tools/bag_reader.py and bag_writer.py know its insides
        'scikit-fuzzy',
        'scipy',
        'setuptools',
        'tqdm',
    ],
    # Not tests_require: colcon then finds no tests.
    extras_require={
        # Community builds of Jazzy, for machines without ROS. Never beside an installed ROS.
        'ros': [
            'ros-jazzy-builtin-interfaces',
            'ros-jazzy-diagnostic-msgs',
            'ros-jazzy-lifecycle-msgs',
            'ros-jazzy-rcl-interfaces',
            'ros-jazzy-rclpy[fastrtps]',
            'ros-jazzy-rosgraph-msgs',
            'ros-jazzy-std-msgs',
            'ros-jazzy-std-srvs',
        ],
        'tune': TUNE,
        'compare': TUNE,
        'test': [
            *TUNE,
            'colcon-common-extensions',
            'hypothesis',
            'import-linter',
            'mcap',
            'mcap-ros2-support',
            'mypy',
            'pytest',
            'pytest-rerunfailures',
            'pytest-xdist',
            'ruff',
            'setuptools>=68,<80',  # from 80 on, colcon build --symlink-install silently copies
            'sympy',
            'types-PyYAML',
        ],
    },
    entry_points={
        'console_scripts': [
            # Not the module's own main: what it imports takes a second, and signals come sooner.
            f'{command} = fhaosmo_ros.__main__:{command}'
            for command in COMMANDS
        ],
    },
)
