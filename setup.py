# SPDX-License-Identifier: Apache-2.0
"""
Build script of the ROS 2 package: colcon, pip and scripts/environment.sh read it.

colcon runs the commands `install` and `develop`; setup.cfg sends their scripts to lib/fhaosmo_ros,
where `ros2 run` looks for executables: one for each command. pip builds a wheel, whose scripts go
to bin, on everybody's PATH: there `record`, `play`, `plot` and others would hide programs of the
same name (sox and ImageMagick have some), so a wheel has one script, `fhaosmo COMMAND`.
"""

import multiprocessing
import os
from pathlib import Path
import sys

from fhaosmo_ros import __version__
from fhaosmo_ros.commands import COMMANDS
from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

NAME = 'fhaosmo_ros'
FOR_ROS2_RUN = bool({'install', 'develop'} & set(sys.argv))
CHECK = ['hypothesis', 'pytest', 'pytest-xdist']
TUNE = ['cmaes', 'optuna>=4,<6']
ARM = ['pin>=3.3,<5']
DOCS = ['myst-parser', 'sphinx', 'sphinx-rtd-theme']
TEST = [
    *ARM, *CHECK, *DOCS, *TUNE, 'colcon-common-extensions', 'cython-lint', 'import-linter',
    'mcap-ros2-support', 'mypy', 'ruff', 'sympy', 'types-PyYAML',
    'scikit-fuzzy', 'networkx', 'packaging',  # it imports these two but declares nothing
    'setuptools>=68,<80',  # from 80 on, colcon build --symlink-install silently copies
]  # fmt: skip
ROS = (
    'builtin-interfaces', 'diagnostic-msgs', 'geometry-msgs', 'lifecycle-msgs', 'rcl-interfaces',
    'rclpy', 'rmw-fastrtps-cpp', 'rosgraph-msgs', 'sensor-msgs', 'std-msgs', 'std-srvs',
)  # fmt: skip
"""What the nodes need of a ROS distribution."""
DEBUG = os.environ.get('FHAOSMO_DEBUG') == '1'
DIRECTIVES = {
    'language_level': 3, 'boundscheck': DEBUG, 'wraparound': False, 'initializedcheck': DEBUG,
    'cdivision': True, 'show_performance_hints': False,
}  # fmt: skip
"""Of Cython, for all of the package."""


def extensions():
    """
    Return one extension for each .pyx file; `build_ext` below translates and compiles them.

    In the environment, FHAOSMO_DEBUG=1 builds with bounds checks; CFLAGS and LDFLAGS may have
    -fsanitize=address. Loops over the members of the self-tuning observer are sums that may be
    taken in any order, so that they become vector instructions; see core/vectors.pxd. All else
    gives the same bits on each processor (no product and sum are contracted), and -O3 makes it no
    faster. What is compiled of studies/ is built in a checkout, never installed.
    """
    found = []
    for path in sorted([*Path(NAME).rglob('*.pyx'), *Path('studies').rglob('*.pyx')]):
        options = ['-fno-math-errno', *(['-O1', '-g'] if DEBUG else ['-O2', '-g0'])]
        if {'self_tuning', 'arm'} & set(path.parts):
            options += ['-fno-trapping-math', '-fno-signed-zeros', '-fassociative-math']
            options += [] if DEBUG else ['-O3']
        else:
            options.append('-ffp-contract=off')
        name = '.'.join(path.with_suffix('').parts)
        found.append(Extension(name, [str(path)], libraries=['m'], extra_compile_args=options))
    return found


class BuildExtensions(build_ext):
    """Translates by Cython what has changed, or what it cimports, and compiles on all cores."""

    def finalize_options(self):
        """Leave out the studies unless the extensions are built within the checkout."""
        if not (self.inplace or self.editable_mode):
            self.distribution.ext_modules[:] = [
                e for e in self.distribution.ext_modules if e.name.startswith(NAME)
            ]
        super().finalize_options()
        self.parallel = self.parallel or os.cpu_count()

    def run(self):
        """Build; all of it if options, compiler or Cython are not those of the last build."""
        try:
            from Cython import __version__ as version
            from Cython.Build import cythonize
        except ImportError:
            sys.exit("error: Cython is needed to build: pip install 'Cython>=3'")
        # The mark of scripts/environment.sh that what lies in the checkout is up to date.
        Path('build/in_place').unlink(missing_ok=True)
        options = sorted({tuple(extension.extra_compile_args) for extension in self.extensions})
        compiler = [os.environ.get(name) for name in ('CC', 'CFLAGS', 'LDFLAGS')]
        made_with = repr((version, compiler, DIRECTIVES, options))
        mark = Path(self.build_temp, 'made_with')
        self.force = self.force or not mark.is_file() or mark.read_text() != made_with
        # Processes, not threads: Cython is Python. They must not run this file again.
        multiprocessing.set_start_method('fork', force=True)
        translated = cythonize(
            list(self.extensions), nthreads=self.parallel, quiet=True, force=self.force,
            build_dir=self.build_temp, compiler_directives=DIRECTIVES,
        )  # fmt: skip
        for extension, c in zip(self.extensions, translated, strict=True):
            extension.sources = c.sources
        super().run()
        mark.write_text(made_with)


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
    package_data={'': ['*.pxd', '*.pyi']},
    ext_modules=extensions(),
    cmdclass={'build_ext': BuildExtensions},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *files('config/**/*.*', 'launch/*.py', 'docs/*.md', 'docs/**/*.png', 'docs/*.svg'),
    ],
    zip_safe=False,
    install_requires=[
        'matplotlib',
        'mcap>=1.6,<1.7',  # tools/bags uses two attributes of its Writer
        'numpy',
        'pyyaml',
        'rosbags>=0.11.9,<0.12',  # tools/bags uses its internals
        'scipy',
        'tqdm',
        'zstandard',
    ],
    # Not tests_require: colcon then finds no tests.
    extras_require={
        'arm': ARM,
        # Worlds and robots of studies/arm.
        'arm-study': [*ARM, *TUNE, 'example-robot-data', 'mujoco>=4,<5', 'pybullet'],
        'docs': DOCS,
        # Community builds, for machines without ROS. Never beside an installed ROS.
        **{f'ros-{name}': [f'ros-{name}-{p}' for p in ROS] for name in ('jazzy', 'kilted')},
        'tune': TUNE,
        'compare': TUNE,
        'check': CHECK,
        'test': TEST,
    },
    # Not the main of a command's module: importing that takes a second, and a signal during it
    # must end the command too.
    entry_points={
        'console_scripts': [f'{command} = {NAME}.__main__:{command}' for command in COMMANDS]
        if FOR_ROS2_RUN
        else [f'fhaosmo = {NAME}.__main__:main'],
    },
)
