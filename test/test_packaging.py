# SPDX-License-Identifier: Apache-2.0
"""What colcon and pip install, what the launch files start, which environment make chooses."""

import importlib.util
import os
from pathlib import Path
import runpy
import shutil
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

from commands import ROOT
from commands import run as run_program
import fhaosmo_ros
from fhaosmo_ros.__main__ import main
from fhaosmo_ros.commands import COMMANDS
import pytest

NAME = 'fhaosmo_ros'
# A sourced ROS or overlay would leak into the builds and plans below.
SOURCED = ('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'ROS_DISTRO')


def attempt(*command: object, cwd=None, **environment: object) -> subprocess.CompletedProcess:
    kept = {k: v for k, v in os.environ.items() if k not in SOURCED}
    own = {name: str(value) for name, value in environment.items()}
    return run_program(*command, command=(), cwd=cwd, env=kept | own, timeout=None)


def run(*command: object, **options: object) -> str:
    """Run a command, fail with its output if it fails, return what it printed."""
    done = attempt(*command, **options)
    assert done.returncode == 0, f'{command}:\n{done.stdout}\n{done.stderr}'
    return done.stdout


@pytest.fixture(scope='module')
def checkout(tmp_path_factory) -> Path:
    """Return a copy of this tree with what has been compiled, so that building leaves no trace."""
    copy, without = tmp_path_factory.mktemp('workspace') / 'src' / NAME, shutil.ignore_patterns
    shutil.copytree(ROOT, copy, ignore=without('.*', '__pycache__', '*.so', 'build'))
    if (ROOT / 'build').is_dir():
        shutil.copytree(ROOT / 'build', copy / 'build', ignore=without('studies', 'in_place'))
    return copy


@pytest.fixture(scope='module')
def wheel(checkout, tmp_path_factory) -> Path:
    """Return the wheel."""
    folder = tmp_path_factory.mktemp('wheel')
    pip = (sys.executable, '-m', 'pip', '--disable-pip-version-check', 'wheel')
    run(*pip, '--no-deps', '--no-build-isolation', '-w', folder, checkout)
    (path,) = folder.glob('*.whl')
    return path


def test_wheel_has_one_script_and_only_this_package(wheel, checkout, tmp_path):
    """Scripts of a wheel go to bin, where `record` or `plot` would hide other programs."""
    installed = tmp_path / 'installed'
    run(sys.executable, '-m', 'pip', 'install', '--no-deps', '--prefix', installed, wheel)
    assert [path.name for path in (installed / 'bin').iterdir()] == ['fhaosmo']
    (packages,) = installed.glob('lib/python*/site-packages')
    assert {path.name for path in packages.iterdir() if path.suffix != '.dist-info'} == {NAME}
    assert (installed / 'share' / NAME / 'config' / 'demo.yaml').is_file()
    printed = run(installed / 'bin' / 'fhaosmo', '--help', PYTHONPATH=packages)
    assert all(command in printed for command in COMMANDS)
    compiled = {path.name.split('.')[0] for path in packages.rglob('*.so')}
    assert {path.stem for path in (checkout / NAME).rglob('*.pyx')} <= compiled
    # Others can cimport the observer.
    assert (packages / NAME / 'core' / 'observer' / 'structure.pxd').is_file()
    assert not [*packages.rglob('*.c'), *packages.rglob('*.pyx')]


@pytest.mark.parametrize('options', [[], ['--symlink-install']], ids=['copied', 'symlinked'])
def test_colcon_installs_executables_and_data(options, wheel, checkout, tmp_path):
    """It finds what was compiled for the wheel in its build folder, and compiles little anew."""
    if importlib.util.find_spec('colcon_core') is None:
        pytest.skip('colcon is not installed (pip install colcon-common-extensions)')
    shutil.copytree(checkout / 'build', tmp_path / 'build' / NAME / 'build')
    installed = tmp_path / 'install'
    run(
        sys.executable, '-m', 'colcon', '--log-base', tmp_path / 'log', 'build', *options,
        '--base-paths', checkout, '--build-base', tmp_path / 'build', '--install-base', installed,
        cwd=tmp_path,
    )  # fmt: skip
    prefix = installed / NAME
    executables = list((prefix / 'lib' / NAME).iterdir())
    assert {path.name for path in executables} == set(COMMANDS)
    assert all(os.access(path, os.X_OK) for path in executables)
    assert not (prefix / 'bin').exists()
    for other in ('studies', 'benchmark', 'test', '*.c', '*.pyx'):
        assert not list(prefix.rglob(other))
    share = prefix / 'share' / NAME
    for pattern in ('config/**/*.yaml', 'config/*.xml', 'launch/*.py', 'package.xml', 'docs/*.md'):
        expected = {path.relative_to(checkout) for path in checkout.glob(pattern)}
        assert {path.relative_to(share) for path in share.glob(pattern)} == expected
    assert (prefix / 'share/ament_index/resource_index/packages' / NAME).is_file()
    assert f'<version>{fhaosmo_ros.__version__}</version>' in (share / 'package.xml').read_text()

    def sourced(command: str) -> str:
        return run('bash', '-c', f'. {installed}/setup.bash && {command}', cwd=tmp_path)

    # Unset, it means that colcon took the package for plain Python, not ament_python.
    assert str(prefix) in sourced('echo "$AMENT_PREFIX_PATH"').strip().split(':')
    # --symlink-install must run the sources themselves, so that an edit takes effect.
    query = f'import {NAME}; print({NAME}.__file__)'
    imported = Path(sourced(f'{sys.executable} -c "{query}"').strip())
    assert imported.resolve().is_relative_to(checkout if options else installed)
    assert '--duration' in sourced(f'{prefix}/lib/{NAME}/demo --help')


@pytest.fixture
def started(monkeypatch):
    """Return a function that gives the nodes of a launch file with some arguments."""

    def start(name: str, **arguments: str) -> list[dict]:
        launch = MagicMock()  # the launch packages are not on PyPI
        for package in ('launch', 'launch_ros'):
            for part in ('', '.actions', '.substitutions', '.conditions'):
                monkeypatch.setitem(sys.modules, package + part, launch)
        given = {}
        launch.LaunchConfiguration = lambda name: SimpleNamespace(perform=lambda _: given[name])
        path = ROOT / 'launch' / f'{name}.launch.py'
        runpy.run_path(str(path))['generate_launch_description']()
        for (argument,), options in launch.DeclareLaunchArgument.call_args_list:
            value = given[argument] = arguments.pop(argument, options['default_value'])
            if value not in (options.get('choices') or [value]):  # as launch does
                raise ValueError(argument)
        assert not arguments
        launch.OpaqueFunction.call_args.kwargs['function'](None)
        return [call.kwargs for call in launch.Node.call_args_list]

    return start


def test_launch_files_start_their_nodes_with_files_that_are_there(started, tmp_path):
    plotjuggler, plant, estimator = started('demo', namespace='/rig', use_sim_time='True')
    assert Path(plotjuggler['arguments'][-1]).is_file()
    expected = [str(ROOT / 'config/demo.yaml'), {'use_sim_time': True}]
    for node in (plant, estimator):
        assert (node['parameters'], node['namespace']) == (expected, '/rig')
        assert node['on_exit'] is not None  # where one ends, so does the other
    for name, file in ('arm', 'arm'), ('joint_estimator', 'joint_states'):
        (node,) = started(name)
        assert (node['name'], node['on_exit']) == (name, None)
        assert node['parameters'] == [str(ROOT / f'config/{file}.yaml')]
    own = {'input_topic': '/joint_states', 'input_field': 'position[elbow]'}
    (node,) = started('estimator', params_file=__file__, autostart='false', respawn='true', **own)
    assert node['parameters'] == [__file__, {'autostart': False} | own]
    assert node['respawn'] is True
    with pytest.raises(FileNotFoundError, match=f'params_file: .* got {tmp_path}'):
        started('estimator', params_file=str(tmp_path))
    with pytest.raises(ValueError, match='respawn'):  # not taken for false
        started('estimator', respawn='yes')


FAKE = {
    'ROS': ('rclpy.py', ''), 'no compiler': ('nothing', ''),
    'broken': ('rclpy.py', 'raise ImportError("built for another Python")'),
    'old': ('python3', '#!/bin/sh\n[ "$1" = -V ] && echo Python 3.9.1\nexit 1\n'),
    'no headers': (
        'sitecustomize.py',
        'import sysconfig\nsysconfig.get_path = lambda name: "/nowhere/python3.99"\n',
    ),
}  # fmt: skip
"""A file in the folder that PYTHONPATH names."""
JAZZY = {'ROS_DISTRO': 'jazzy'}


@pytest.mark.parametrize(('fake', 'environment', 'code', 'said'), [
    ('', {}, 0, 'venv: .venv\nwheels: jazzy\n'),
    ('', {'ROS_WHEELS': 'kilted'}, 0, 'venv: .venv-kilted\nwheels: kilted\n'),
    ('no compiler', {'PATH': '{}'}, 0, 'wheels: jazzy\ncompiler: ziglang\n'),
    ('ROS', JAZZY, 0, 'venv: .venv-ros\nwheels: no\n'),
    ('ROS', {'ROS_DISTRO': 'rolling'}, 0, 'warning: only ROS 2 Jazzy and Kilted are tested'),
    ('broken', JAZZY | {'AMENT_PREFIX_PATH': '/opt'}, 1, 'cannot import rclpy'),
    ('old', {'PYTHON': '{}/python3'}, 1, 'Python 3.10 or later is needed'),
    ('no headers', {}, 1, '/nowhere/python3.99/Python.h is missing'),
])  # fmt: skip
def test_plan_of_the_environment(fake, environment, code, said, tmp_path):
    """Without the headers of Python nothing is begun; the rest is only planned."""
    (tmp_path / 'dirname').symlink_to(shutil.which('dirname'))  # all that it needs of the system
    for folder in ('scripts', NAME, 'studies'):
        (tmp_path / folder).mkdir()
    (tmp_path / 'setup.py').touch()
    script = shutil.copy(ROOT / 'scripts' / 'environment.sh', tmp_path / 'scripts')
    if fake:
        name, text = FAKE[fake]
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    environment = {k: v.format(tmp_path) for k, v in environment.items()}
    environment = {'PYTHON': sys.executable, 'PYTHONPATH': tmp_path, **environment}
    plan = [] if fake == 'no headers' else ['--print-plan']
    done = attempt(shutil.which('sh'), script, *plan, **environment)
    assert done.returncode == code, done.stderr
    assert said in done.stdout + done.stderr
    assert len(done.stderr.splitlines()) <= 1
    assert not (tmp_path / '.venv').exists()


@pytest.mark.parametrize(('arguments', 'code', 'words'), [
    (['estimater'], 2, ["no command 'estimater'", *COMMANDS]),
    ([], 2, COMMANDS), (['fake'], 1, ["'no_such_module_here'"]),
    (['--version'], 0, [f'fhaosmo_ros {fhaosmo_ros.__version__}\n']),
])  # fmt: skip
def test_what_the_package_itself_says(arguments, code, words, capsys, monkeypatch):
    monkeypatch.setitem(COMMANDS, 'fake', ('no_such_module_here', ''))
    assert main(arguments) == code
    out, error = capsys.readouterr()
    said, nothing = (error, out) if code else (out, error)
    assert nothing == ''
    assert [word for word in words if word not in said] == []
