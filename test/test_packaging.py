# SPDX-License-Identifier: Apache-2.0
"""What colcon and pip install, what the launch files start, which environment make chooses."""

from functools import partial
import importlib.util
import os
from pathlib import Path
import runpy
import shutil
import subprocess
import sys
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import fhaosmo_ros
from fhaosmo_ros.__main__ import main
from fhaosmo_ros.commands import COMMANDS
import pytest

ROOT = Path(__file__).resolve().parents[1]
NAME = 'fhaosmo_ros'
ENVIRONMENT = ROOT / 'scripts' / 'environment.sh'
# A sourced ROS or overlay would leak into the builds and plans below.
SOURCED = ('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'ROS_DISTRO')


def clean_environment(**extra: object) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if k not in SOURCED}
    return kept | {k: str(v) for k, v in extra.items()}


def attempt(*command: object, cwd=None, **environment: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, cwd=cwd,
        env=clean_environment(**environment), check=False,
    )  # fmt: skip


def run(*command: object, cwd=None, **environment: object) -> str:
    """Run a command, fail with its output if it fails, return what it printed."""
    done = attempt(*command, cwd=cwd, **environment)
    assert done.returncode == 0, f'{command}:\n{done.stdout}\n{done.stderr}'
    return done.stdout


# pip and colcon


@pytest.fixture(scope='module')
def checkout(tmp_path_factory) -> Path:
    """
    Return a copy of this tree's own files, so that building leaves no trace in it.

    What has been compiled in place comes with it, and is not compiled again.
    """
    if shutil.which('git') is None or not (ROOT / '.git').exists():
        pytest.skip('not a git checkout: no list of the files that belong to it')
    listing = run('git', '-C', ROOT, 'ls-files', '-co', '--exclude-standard', '-z')
    copy = tmp_path_factory.mktemp('workspace') / 'src' / NAME
    for name in filter(None, listing.split('\0')):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    for compiled in filter(Path.is_file, (ROOT / 'build').glob('*/**/*')):
        part = compiled.relative_to(ROOT)
        source = Path(*part.parts[2:]).with_name(f'{part.name.split(".")[0]}.pyx')
        if part.name == 'made_with' or (NAME in part.parts and (copy / source).is_file()):
            (copy / part).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(compiled, copy / part)
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
    core = packages / NAME / 'core'
    sources = {path.relative_to(checkout) for path in (checkout / NAME).rglob('*.pyx')}
    compiled = {path.relative_to(packages) for path in core.rglob('*.so')}
    assert {path.with_suffix('') for path in sources} == {
        path.with_name(path.name.split('.')[0]) for path in compiled
    }
    assert (core / 'observer' / 'structure.pxd').is_file()  # others can cimport the observer
    assert not [*packages.rglob('*.c'), *packages.rglob('*.pyx')]
    estimate = f'from {NAME}.core import Observer; print(Observer().step(0.0, 1.0).status == 0)'
    assert run(sys.executable, '-c', estimate, cwd=tmp_path, PYTHONPATH=packages) == 'True\n'


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
    if shutil.which('bash') is None:
        pytest.skip('bash is not installed')

    def sourced(command: str) -> str:
        return run('bash', '-c', f'. {installed}/setup.bash && {command}', cwd=tmp_path)

    # Unset, it means that colcon took the package for plain Python, not ament_python.
    assert str(prefix) in sourced('echo "$AMENT_PREFIX_PATH"').strip().split(':')
    # --symlink-install must run the sources themselves, so that an edit takes effect.
    query = f'import {NAME}; print({NAME}.__file__)'
    imported = Path(sourced(f'{sys.executable} -c "{query}"').strip())
    assert imported.resolve().is_relative_to(checkout if options else installed)
    assert '--duration' in sourced(f'{prefix}/lib/{NAME}/demo --help')


# setup.py build_ext

SMALL = {
    'fhaosmo_ros/__init__.py': "__version__ = '0'",
    'fhaosmo_ros/commands.py': 'COMMANDS = {}',
    'fhaosmo_ros/number.pxd': (
        'cdef enum: NUMBER = 3\ncdef class Numbers:\n    cdef double[4] values'
    ),
    'fhaosmo_ros/number.pyx': """
cdef class Numbers:
    def __getitem__(self, Py_ssize_t index):
        cdef double[:] values = self.values
        return values[index]
""",
    'fhaosmo_ros/taken.pyx': (
        'from fhaosmo_ros.number cimport NUMBER\ndef number():\n    return NUMBER\n'
    ),
}
OUT_OF_BOUNDS = """
from fhaosmo_ros.number import Numbers
try:
    Numbers()[4]
except IndexError:
    print('checked')
"""


def test_only_what_has_changed_is_built(tmp_path):
    """Of a package of two small extensions with this package's setup.py."""

    def build(debug: int = 1) -> dict[str, int]:
        """Return when each extension was compiled (ns); a debug build takes half the time."""
        command = (sys.executable, 'setup.py', '-q', 'build_ext', '-i')
        assert run(*command, cwd=tmp_path, FHAOSMO_DEBUG=debug) == ''
        libraries = (tmp_path / 'build').glob('lib*/**/*.so')
        return {path.name.split('.')[0]: path.stat().st_mtime_ns for path in libraries}

    def change(name: str, old: str, new: str) -> None:
        path = tmp_path / NAME / name
        path.write_text(path.read_text().replace(old, new))

    (tmp_path / NAME).mkdir()
    for name, text in SMALL.items():
        (tmp_path / name).write_text(text)
    for name in ('setup.py', 'setup.cfg'):
        shutil.copy(ROOT / name, tmp_path)
    first = build()
    assert set(first) == {'number', 'taken'}
    assert not list((tmp_path / NAME).rglob('*.c'))
    assert build() == first
    change('taken.pyx', 'return NUMBER', 'return NUMBER + 0')
    second = build()
    assert second['number'] == first['number']
    assert second['taken'] > first['taken']
    change('number.pxd', 'NUMBER = 3', 'NUMBER = 4')
    build()
    query = f'from {NAME}.taken import number; print(number())'
    assert run(sys.executable, '-c', query, cwd=tmp_path) == '4\n'
    # A debug build checks bounds, and is not taken for a normal one.
    assert run(sys.executable, '-c', OUT_OF_BOUNDS, cwd=tmp_path) == 'checked\n'
    build(debug=0)
    assert run(sys.executable, '-c', OUT_OF_BOUNDS, cwd=tmp_path) == ''


# package.xml


def test_package_xml():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    found = [package.findtext(tag) for tag in ('name', 'version', 'export/build_type')]
    assert found == [NAME, fhaosmo_ros.__version__, 'ament_python']
    needed = {tag.text for tag in package.findall('exec_depend')}
    assert {'rclpy', 'std_msgs', 'std_srvs', 'launch_ros', 'python3-numpy'} <= needed
    assert {'cython3', 'python3-dev'} <= {tag.text for tag in package.findall('build_depend')}
    catkin_pkg = pytest.importorskip('catkin_pkg.package', reason='catkin_pkg is not installed')
    said: list[str] = []
    catkin_pkg.parse_package(str(ROOT / 'package.xml'), warnings=said).validate(warnings=said)
    assert said == []


# launch


@pytest.fixture
def started(monkeypatch):
    """Return a function that gives the nodes of a launch file with some arguments."""
    given: dict[str, str] = {}

    def make(kind, *args, **kwargs):
        """Stand for any class of the launch packages, which are not on PyPI."""
        return SimpleNamespace(
            kind=kind, args=args, kwargs=kwargs, perform=lambda context: given[args[0]],
            add_action=lambda action: args[0].append(action),
        )  # fmt: skip

    for name in ('launch', 'launch_ros'):
        for part in ('', '.actions', '.substitutions', '.conditions'):
            module = ModuleType(name + part)
            module.__getattr__ = lambda kind: partial(make, kind)
            monkeypatch.setitem(sys.modules, name + part, module)

    def start(name: str, **arguments: str) -> list[dict]:
        path = ROOT / 'launch' / f'{name}.launch.py'
        (entities,) = runpy.run_path(str(path))['generate_launch_description']().args
        declared, functions, nodes = (
            [entity for entity in entities if entity.kind == kind]
            for kind in ('DeclareLaunchArgument', 'OpaqueFunction', 'Node')
        )
        given.update({entity.args[0]: entity.kwargs['default_value'] for entity in declared})
        assert set(arguments) <= {entity.args[0] for entity in declared}
        given.update(arguments)
        (function,) = functions
        return [node.kwargs for node in [*function.kwargs['function'](None), *nodes]]

    return start


def test_launch_files_start_their_nodes_with_files_that_are_there(started, tmp_path):
    plant, estimator, plotjuggler = started('demo', namespace='/rig', use_sim_time='True')
    assert Path(plotjuggler['arguments'][-1]).is_file()
    expected = [str(ROOT / 'config/demo.yaml'), {'use_sim_time': True}]
    for node in (plant, estimator):
        assert (node['parameters'], node['namespace']) == (expected, '/rig')
        assert node['on_exit'].kind == 'Shutdown'
    for name, file, executable in (
        ('arm', 'arm', 'arm'), ('joint_estimator', 'joint_states', 'estimator'),
    ):  # fmt: skip
        (node,) = started(name)
        assert (node['executable'], node['name'], node['on_exit']) == (executable, name, None)
        assert node['parameters'][0] == str(ROOT / f'config/{file}.yaml')
    for name in ('demo', 'estimator', 'arm'):
        with pytest.raises(FileNotFoundError, match=f'params_file: .* got {tmp_path}'):
            started(name, params_file=str(tmp_path))


def test_estimator_launch_file_leaves_to_the_file_what_is_not_given(started, tmp_path):
    (node,) = started('estimator')
    assert node['parameters'] == [{'use_sim_time': False, 'autostart': True}]
    path = tmp_path / 'some.yaml'
    path.touch()
    own = {'input_topic': '/joint_states', 'input_field': 'position[elbow]'}
    (node,) = started('estimator', params_file=str(path), autostart='false', respawn='true', **own)
    assert node['parameters'] == [str(path), {'use_sim_time': False, 'autostart': False} | own]
    assert node['respawn'] is True


# scripts/environment.sh

FAKE = {
    'here': ('rclpy.py', ''),
    'broken': ('rclpy.py', 'raise ImportError("built for another Python")'),
    'no headers': (
        'sitecustomize.py',
        'import sysconfig\nsysconfig.get_path = lambda name: "/nowhere/python3.99"\n',
    ),
    'old': ('python3', '#!/bin/sh\n[ "$1" = -V ] && echo Python 3.9.1\nexit 1\n'),
    'no compiler': ('nothing', ''),
}
"""A file in the folder that PYTHONPATH names."""
ROS, JAZZY = 'venv: .venv-ros\nwheels: no\n', {'ROS_DISTRO': 'jazzy'}


@pytest.mark.parametrize(('fake', 'environment', 'printed', 'said'), [
    (None, {}, 'venv: .venv\nwheels: jazzy\n', []),
    (None, {'ROS_WHEELS': 'kilted'}, 'venv: .venv-kilted\nwheels: kilted\n', []),
    (None, {'CC': sys.executable}, f'wheels: jazzy\ncompiler: {sys.executable}\n', []),
    ('no compiler', {'PATH': '{}'}, 'wheels: jazzy\ncompiler: ziglang\n', []),
    ('here', JAZZY, ROS, []),
    ('here', {'ROS_DISTRO': 'rolling'}, ROS, ['only ROS 2 Jazzy and', 'sourced is rolling']),
    ('broken', JAZZY | {'AMENT_PREFIX_PATH': '/opt'}, None, ['cannot import rclpy']),
    ('old', {'PYTHON': '{}/python3'}, None, ['Python 3.10 or later', 'Python 3.9.1']),
])  # fmt: skip
def test_plan_of_the_environment(fake, environment, printed, said, tmp_path):
    (tmp_path / 'dirname').symlink_to(shutil.which('dirname'))  # all that it needs of the system
    if fake:
        name, text = FAKE[fake]
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    environment = {k: v.format(tmp_path) for k, v in environment.items()}
    environment = {'PYTHON': sys.executable, 'PYTHONPATH': tmp_path, **environment}
    done = attempt(shutil.which('sh'), ENVIRONMENT, '--print-plan', **environment)
    assert done.returncode == (printed is None), done.stderr
    assert (printed or '') in done.stdout
    assert len(done.stderr.splitlines()) == bool(said)
    assert all(words in done.stderr for words in said)


def test_without_the_headers_of_python_nothing_is_begun(tmp_path):
    name, text = FAKE['no headers']
    (tmp_path / name).write_text(text)
    for folder in ('scripts', NAME, 'studies'):
        (tmp_path / folder).mkdir()
    script = shutil.copy(ENVIRONMENT, tmp_path / 'scripts')
    (tmp_path / 'setup.py').touch()
    done = attempt('sh', script, PYTHON=sys.executable, PYTHONPATH=tmp_path)
    assert done.returncode == 1
    assert '/nowhere/python3.99/Python.h is missing' in done.stderr
    assert 'apt install python3.99-dev' in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / '.venv').exists()


# python -m fhaosmo_ros


@pytest.mark.parametrize(('arguments', 'code', 'words'), [
    (['estimater'], 2, ["no command 'estimater'", "did you mean 'estimator'?", *COMMANDS]),
    ([], 2, COMMANDS),
    (['--help'], 0, COMMANDS),
    (['--version'], 0, [f'fhaosmo_ros {fhaosmo_ros.__version__}\n']),
    (['fake'], 1, ["'no_such_module_here'"]),
])  # fmt: skip
def test_what_the_package_itself_says(arguments, code, words, capsys, monkeypatch):
    monkeypatch.setitem(COMMANDS, 'fake', ('no_such_module_here', ''))
    assert main(arguments) == code
    out, error = capsys.readouterr()
    said, nothing = (error, out) if code else (out, error)
    assert nothing == ''
    assert all(word in said for word in words if word != 'fake')
    # A command gets its arguments, and its code is returned.
    monkeypatch.setitem(sys.modules, 'no_such_module_here', SimpleNamespace(main=len))
    assert main(['fake', 'one', '--two']) == 2
