# SPDX-License-Identifier: Apache-2.0
"""What colcon and pip install, what the launch file starts, which environment make chooses."""

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
# A sourced ROS or overlay would leak into the builds and plans below.
SOURCED = ('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'ROS_DISTRO')


def clean_environment(**extra: str) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if k not in SOURCED}
    return kept | {'FHAOSMO_DEBUG': '1'} | extra  # compiles in half the time


def run(*command: object, **options) -> str:
    """Run a command, fail with its output if it fails, return what it printed."""
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, **options
    )
    assert done.returncode == 0, f'{command}:\n{done.stdout}\n{done.stderr}'
    return done.stdout


# colcon


@pytest.fixture(scope='module')
def checkout(tmp_path_factory) -> Path:
    """Return a copy of this tree's own files, so that building leaves no trace in it."""
    if shutil.which('git') is None or not (ROOT / '.git').exists():
        pytest.skip('not a git checkout: no list of the files that belong to it')
    listing = run('git', '-C', ROOT, 'ls-files', '-co', '--exclude-standard', '-z')
    copy = tmp_path_factory.mktemp('workspace') / 'src' / NAME
    for name in filter(None, listing.split('\0')):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, copy / name)
    return copy


@pytest.fixture(scope='module', params=['copied', 'symlinked'])
def installed(request, checkout, tmp_path_factory) -> Path:
    """Build with colcon and return the install folder."""
    if importlib.util.find_spec('colcon_core') is None:
        pytest.skip('colcon is not installed (pip install colcon-common-extensions)')
    base = tmp_path_factory.mktemp(request.param)
    options = ['--symlink-install'] if request.param == 'symlinked' else []
    # fmt: off
    run(
        sys.executable, '-m', 'colcon', '--log-base', base / 'log', 'build', *options,
        '--base-paths', checkout, '--build-base', base / 'build', '--install-base',
        base / 'install', cwd=base, env=clean_environment(),
    )
    # fmt: on
    return base / 'install'


def test_colcon_installs_executables_and_data(installed, checkout):
    prefix = installed / NAME
    executables = {path.name for path in (prefix / 'lib' / NAME).iterdir()}
    assert executables == set(COMMANDS)
    for command in COMMANDS:
        assert os.access(prefix / 'lib' / NAME / command, os.X_OK)
    assert not (prefix / 'bin').exists()
    for other in ('studies', 'benchmark', 'test', '*.c', '*.pyx'):
        assert not list(prefix.rglob(other))
    share = prefix / 'share' / NAME
    for pattern in ('config/**/*.yaml', 'config/*.xml', 'launch/*.py', 'package.xml', 'docs/*.md'):
        expected = {path.relative_to(checkout) for path in checkout.glob(pattern)}
        assert {path.relative_to(share) for path in share.glob(pattern)} == expected
    assert (share / 'launch' / 'demo.launch.py').is_file()
    assert (prefix / 'share/ament_index/resource_index/packages' / NAME).is_file()


def test_sourcing_sets_the_ament_prefix(installed):
    """Unset, it means that colcon took the package for plain Python, not ament_python."""
    if shutil.which('bash') is None:
        pytest.skip('bash is not installed')
    script = f'. {installed}/setup.bash && echo "$AMENT_PREFIX_PATH"'
    printed = run('bash', '-c', script, env=clean_environment())
    assert str(installed / NAME) in printed.strip().split(':')


def test_sourced_package_is_the_built_one(installed, checkout, tmp_path):
    """--symlink-install must run the sources themselves, so that an edit takes effect."""
    if shutil.which('bash') is None:
        pytest.skip('bash is not installed')
    query = f'import {NAME}; print({NAME}.__file__)'
    script = f'. {installed}/setup.bash && {sys.executable} -c "{query}"'
    printed = run('bash', '-c', script, env=clean_environment(), cwd=tmp_path)
    imported = Path(printed.strip())
    assert imported.is_relative_to(installed.parent) or imported.is_relative_to(checkout)
    symlinked = installed.parent.name.startswith('symlinked')
    assert imported.resolve().is_relative_to(checkout if symlinked else installed)


def test_executable_starts_with_only_the_overlay_sourced(installed, tmp_path):
    """An executable that cannot find its package or its interpreter fails here."""
    script = f'. {installed}/setup.bash && {installed}/{NAME}/lib/{NAME}/demo --help'
    assert '--duration' in run('bash', '-c', script, env=clean_environment(), cwd=tmp_path)


# pip


def test_wheel_has_one_script_and_only_this_package(checkout, tmp_path):
    """Scripts of a wheel go to bin, where `record` or `plot` would hide other programs."""
    pip = (sys.executable, '-m', 'pip', '--disable-pip-version-check')
    options = ('--no-deps', '--no-build-isolation')
    build = tmp_path / 'build'  # setuptools builds within the sources
    shutil.copytree(checkout, build)
    run(*pip, 'wheel', *options, '-w', tmp_path, build, env=clean_environment())
    (wheel,) = tmp_path.glob('*.whl')
    installed = tmp_path / 'installed'
    run(*pip, 'install', '--no-deps', '--prefix', installed, wheel, env=clean_environment())
    assert [path.name for path in (installed / 'bin').iterdir()] == ['fhaosmo']
    (packages,) = installed.glob('lib/python*/site-packages')
    assert {path.name for path in packages.iterdir() if path.suffix != '.dist-info'} == {NAME}
    assert (installed / 'share' / NAME / 'config' / 'demo.yaml').is_file()
    printed = run(
        installed / 'bin' / 'fhaosmo', '--help', env=clean_environment(PYTHONPATH=str(packages))
    )
    assert printed.startswith('usage: fhaosmo COMMAND')
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
    environment = clean_environment(PYTHONPATH=str(packages))
    assert run(sys.executable, '-c', estimate, cwd=tmp_path, env=environment) == 'True\n'


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
        'from fhaosmo_ros.number cimport NUMBER\ndef number():\n    return NUMBER'
    ),
}
OUT_OF_BOUNDS = """
from fhaosmo_ros.number import Numbers
try:
    Numbers()[4]
except IndexError:
    print('checked')
else:
    print('unchecked')
"""


@pytest.fixture
def small(tmp_path) -> Path:
    """Return a package of two small extensions with this package's setup.py."""
    for name, text in SMALL.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    for name in ('setup.py', 'setup.cfg'):
        shutil.copy(ROOT / name, tmp_path)
    return tmp_path


def build(folder: Path, **environment: str) -> None:
    command = (sys.executable, 'setup.py', '-q', 'build_ext', '--inplace')
    printed = run(*command, cwd=folder, env=clean_environment(**environment))
    assert printed == ''


def built(folder: Path) -> dict[str, int]:
    """Return when each extension was compiled (ns)."""
    libraries = (folder / 'build').glob('lib*/**/*.so')
    return {path.name.split('.')[0]: path.stat().st_mtime_ns for path in libraries}


def test_only_what_has_changed_is_built(small):
    build(small)
    first = built(small)
    assert set(first) == {'number', 'taken'}
    assert not list((small / NAME).rglob('*.c'))
    build(small)
    assert built(small) == first
    taken = small / NAME / 'taken.pyx'
    taken.write_text(taken.read_text() + ' + 0')
    build(small)
    second = built(small)
    assert second['number'] == first['number']
    assert second['taken'] > first['taken']
    declarations = small / NAME / 'number.pxd'
    declarations.write_text(declarations.read_text().replace('NUMBER = 3', 'NUMBER = 4'))
    build(small)
    asked = run(
        sys.executable, '-c', f'from {NAME}.taken import number; print(number())', cwd=small
    )
    assert asked == '4\n'


def test_a_debug_build_checks_bounds_and_is_not_taken_for_a_normal_one(small):
    for debug, expected in (('1', 'checked\n'), ('0', 'unchecked\n')):
        build(small, FHAOSMO_DEBUG=debug)
        assert run(sys.executable, '-c', OUT_OF_BOUNDS, cwd=small) == expected


def test_without_cython_the_build_says_so(small):
    (small / 'Cython.py').write_text('raise ImportError')
    command = (sys.executable, 'setup.py', '-q', 'build_ext')
    environment = clean_environment(PYTHONPATH=str(small))
    done = subprocess.run(command, cwd=small, env=environment, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr == "error: Cython is needed to build: pip install 'Cython>=3'\n"


# package.xml


def test_package_xml():
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert package.get('format') == '3'
    assert package.findtext('name') == NAME
    assert package.findtext('version') == fhaosmo_ros.__version__
    assert package.findtext('license') == 'Apache-2.0'
    assert package.findtext('export/build_type') == 'ament_python'
    needed = {tag.text for tag in package.findall('exec_depend')}
    assert {'rclpy', 'std_msgs', 'std_srvs', 'launch_ros', 'python3-numpy'} <= needed
    assert {'cython3', 'python3-dev'} <= {tag.text for tag in package.findall('build_depend')}
    assert 'python3-pytest' in {tag.text for tag in package.findall('test_depend')}


def test_package_xml_is_valid_for_ros_tools():
    catkin_pkg = pytest.importorskip('catkin_pkg.package', reason='catkin_pkg is not installed')
    warnings: list[str] = []
    package = catkin_pkg.parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    package.validate(warnings=warnings)
    assert warnings == []


# launch


class Recorded:
    """Stands for any class of the launch packages: keeps what it was made with."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs


def stub(monkeypatch, module: str, *names: str) -> None:
    """Put a module into sys.modules whose classes record; PyPI has no `launch` to test with."""
    fake = ModuleType(module)
    fake.__path__ = []
    for name in names:
        setattr(fake, name, type(name, (Recorded,), {}))
    monkeypatch.setitem(sys.modules, module, fake)


@pytest.fixture
def stubs(monkeypatch) -> None:
    stub(monkeypatch, 'launch', 'LaunchDescription')
    names = 'DeclareLaunchArgument', 'IncludeLaunchDescription', 'OpaqueFunction', 'Shutdown'
    stub(monkeypatch, 'launch.actions', *names)
    stub(monkeypatch, 'launch.launch_description_sources', 'PythonLaunchDescriptionSource')
    stub(monkeypatch, 'launch.substitutions', 'LaunchConfiguration', 'PathJoinSubstitution')
    stub(monkeypatch, 'launch_ros')
    stub(monkeypatch, 'launch_ros.actions', 'Node')
    stub(monkeypatch, 'launch_ros.parameter_descriptions', 'ParameterValue')
    stub(monkeypatch, 'launch_ros.substitutions', 'FindPackageShare')


@pytest.fixture
def launch_file(stubs) -> dict:
    """Return what the launch file defines."""
    return runpy.run_path(str(ROOT / 'launch' / 'demo.launch.py'))


def test_launch_file_starts_both_nodes(launch_file):
    (entities,) = launch_file['generate_launch_description']().args
    arguments = {e.args[0]: e for e in entities if type(e).__name__ == 'DeclareLaunchArgument'}
    nodes = {e.kwargs['executable']: e.kwargs for e in entities if type(e).__name__ == 'Node'}

    assert set(arguments) == {
        'params_file', 'namespace', 'use_sim_time', 'autostart', 'respawn', 'plotjuggler',
        'log_level',
    }  # fmt: skip
    ((share, *path),) = arguments['params_file'].kwargs['default_value'].args
    assert share.args == (NAME,)
    assert path == ['config', 'demo.yaml']

    assert set(nodes) == {'plant', 'estimator'}
    assert set(nodes) <= set(COMMANDS)
    for node in nodes.values():
        assert node['package'] == NAME
        assert node['namespace'].args == ('namespace',)
        params_file, overrides = node['parameters']
        assert params_file.args == ('params_file',)
        # A bare substitution would reach the node as a string.
        assert set(overrides) == {'use_sim_time', 'autostart'}
        assert all(value.kwargs == {'value_type': bool} for value in overrides.values())
        assert node['ros_arguments'][0] == '--log-level'
        assert node['on_exit'] is launch_file['end']
        assert node['respawn'].args == ('respawn',)
        assert node['respawn_delay'] > 0.0  # `end` is called first, and has time to end the launch
    checks = [e for e in entities if type(e).__name__ == 'OpaqueFunction']
    assert entities.index(checks[-1]) < len(entities) - len(nodes)  # before the nodes
    functions = [check.kwargs['function'] for check in checks]
    assert functions == [launch_file['check_params_file'], launch_file['plotjuggler']]


def test_plotjuggler_is_started_where_it_is_installed(launch_file, tmp_path, monkeypatch):
    function = launch_file['plotjuggler']
    monkeypatch.setattr(Recorded, 'perform', lambda *_: 'false', raising=False)
    assert function(None) == []
    monkeypatch.setattr(Recorded, 'perform', lambda *_: 'true', raising=False)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    with pytest.raises(RuntimeError, match='apt install ros-jazzy-plotjuggler-ros'):
        function(None)
    for package in ('plotjuggler', NAME):
        index = tmp_path / 'share/ament_index/resource_index/packages'
        index.mkdir(parents=True, exist_ok=True)
        (index / package).touch()
        (tmp_path / 'share' / package).mkdir()
    (node,) = function(None)
    layout = Path(node.kwargs['arguments'][-1]).relative_to(tmp_path / 'share' / NAME)
    assert (ROOT / layout).is_file()


@pytest.mark.parametrize('respawn', ['false', 'true'])
def test_launch_ends_with_a_node_and_fails_with_one_that_failed(launch_file, monkeypatch, respawn):
    """An exception in an event's handler makes `ros2 launch` exit with 1."""
    monkeypatch.setattr(Recorded, 'perform', lambda *_: respawn, raising=False)
    ended = SimpleNamespace(process_name='plant-1', returncode=0)
    assert type(launch_file['end'](ended, None)).__name__ == 'Shutdown'
    for code in (1, 2, -11):
        ended.returncode = code
        if respawn == 'true' and code != 2:  # bad parameters do not become better
            assert launch_file['end'](ended, None) is None
            continue
        with pytest.raises(RuntimeError, match=f'plant-1 ended with exit code {code}'):
            launch_file['end'](ended, None)


def test_launch_refuses_a_params_file_that_does_not_exist(launch_file, tmp_path, monkeypatch):
    for path in (tmp_path / 'none.yaml', tmp_path):
        monkeypatch.setattr(Recorded, 'perform', lambda *_, p=path: str(p), raising=False)
        with pytest.raises(FileNotFoundError, match=f'params_file: expected a file, got {path}'):
            launch_file['check_params_file'](None)
    (tmp_path / 'some.yaml').touch()
    monkeypatch.setattr(Recorded, 'perform', lambda *_: str(tmp_path / 'some.yaml'))
    launch_file['check_params_file'](None)


def arguments_of(file: dict) -> dict[str, dict]:
    (entities,) = file['generate_launch_description']().args
    return {e.args[0]: e.kwargs for e in entities if type(e).__name__ == 'DeclareLaunchArgument'}


def test_estimator_launch_file_leaves_to_the_file_what_is_not_given(stubs, monkeypatch, tmp_path):
    file = runpy.run_path(str(ROOT / 'launch' / 'estimator.launch.py'))
    arguments = arguments_of(file)
    given = {name: kwargs['default_value'] for name, kwargs in arguments.items()}
    monkeypatch.setattr(Recorded, 'perform', lambda self, _: given[self.args[0]], raising=False)
    (node,) = file['start'](None)
    assert node.kwargs['executable'] == 'estimator'
    assert node.kwargs['parameters'] == [{'use_sim_time': False, 'autostart': True}]
    path = tmp_path / 'some.yaml'
    path.touch()
    given |= {
        'params_file': str(path), 'use_sim_time': 'true', 'namespace': '/arm',
        'input_topic': '/joint_states', 'input_field': 'position[elbow]', 'log_level': 'debug',
    }  # fmt: skip
    (node,) = file['start'](None)
    assert node.kwargs['namespace'] == '/arm'
    assert node.kwargs['ros_arguments'] == ['--log-level', 'debug']
    first, values = node.kwargs['parameters']
    assert first == str(path)
    assert values == {
        'use_sim_time': True, 'autostart': True, 'input_topic': '/joint_states',
        'input_field': 'position[elbow]',
    }  # fmt: skip
    given['params_file'] = str(tmp_path / 'none.yaml')
    with pytest.raises(FileNotFoundError, match='params_file: expected a file'):
        file['start'](None)


def test_joint_launch_file_includes_the_other_with_arguments_that_it_has(stubs):
    """Composition: every argument passed on is declared by the file that is included."""
    file = runpy.run_path(str(ROOT / 'launch' / 'joint_estimator.launch.py'))
    included = runpy.run_path(str(ROOT / 'launch' / 'estimator.launch.py'))
    arguments = arguments_of(file)
    ((share, *path),) = arguments['params_file']['default_value'].args
    assert (ROOT / Path(*path)).is_file()
    (entities,) = file['generate_launch_description']().args
    (include,) = (e for e in entities if type(e).__name__ == 'IncludeLaunchDescription')
    ((share, *path),) = include.args[0].args[0].args
    assert (ROOT / Path(*path)).is_file()
    assert share.args == (NAME,)
    passed_on = dict(include.kwargs['launch_arguments'])
    assert set(passed_on) <= set(arguments) & set(arguments_of(included))
    assert all(value.args == (name,) for name, value in passed_on.items())


# scripts/environment.sh


def plan(python: object = sys.executable, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        ['sh', ROOT / 'scripts' / 'environment.sh', '--print-plan'],
        env=clean_environment(PYTHON=str(python), **environment),
        capture_output=True,
        text=True,
    )


@pytest.fixture
def fake_ros(tmp_path) -> Path:
    """Return a folder with an importable rclpy, as PYTHONPATH has it where ROS is sourced."""
    (tmp_path / 'rclpy').mkdir()
    (tmp_path / 'rclpy' / '__init__.py').touch()
    return tmp_path


def test_plan_without_ros_takes_the_wheels():
    assert plan().stdout.startswith('venv: .venv\nwheels: jazzy\n')
    assert plan(ROS_WHEELS='kilted').stdout.startswith('venv: .venv-kilted\nwheels: kilted\n')


def test_plan_without_a_compiler_takes_ziglang(tmp_path):
    """`dirname` is all that the plan needs of the system."""
    (tmp_path / 'dirname').symlink_to(shutil.which('dirname'))
    done = subprocess.run(
        [shutil.which('sh'), ROOT / 'scripts' / 'environment.sh', '--print-plan'],
        env={'PATH': str(tmp_path), 'PYTHON': sys.executable},
        capture_output=True,
        text=True,
    )
    assert done.stdout == 'venv: .venv\nwheels: jazzy\ncompiler: ziglang\n', done.stderr
    assert plan(CC=sys.executable).stdout.endswith(f'compiler: {sys.executable}\n')


def test_without_the_headers_of_python_nothing_is_begun(checkout, tmp_path):
    (tmp_path / 'sitecustomize.py').write_text(
        'import sysconfig\nsysconfig.get_path = lambda name: "/nowhere/python3.99"\n'
    )
    folder = tmp_path / 'copy'
    shutil.copytree(checkout, folder)
    done = subprocess.run(
        ['sh', folder / 'scripts' / 'environment.sh'],
        env=clean_environment(PYTHON=sys.executable, PYTHONPATH=str(tmp_path)),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert '/nowhere/python3.99/Python.h is missing' in done.stderr
    assert 'apt install python3.99-dev' in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (folder / '.venv').exists()


def test_plan_with_sourced_jazzy_takes_its_rclpy(fake_ros):
    done = plan(ROS_DISTRO='jazzy', PYTHONPATH=str(fake_ros))
    assert done.stdout.startswith('venv: .venv-ros\nwheels: no\n')
    assert done.stderr == ''


def test_plan_with_another_distribution_warns(fake_ros):
    done = plan(ROS_DISTRO='rolling', PYTHONPATH=str(fake_ros))
    assert done.stdout.startswith('venv: .venv-ros\nwheels: no\n')
    assert 'only ROS 2 Jazzy and Kilted are tested, sourced is rolling' in done.stderr


def test_plan_with_ros_for_another_python_is_an_error(tmp_path):
    (tmp_path / 'rclpy.py').write_text('raise ImportError("built for another Python")')
    done = plan(ROS_DISTRO='jazzy', AMENT_PREFIX_PATH='/opt', PYTHONPATH=str(tmp_path))
    assert done.returncode == 1
    assert done.stdout == ''
    assert 'cannot import rclpy' in done.stderr


def test_plan_with_an_old_python_is_an_error(tmp_path):
    old = tmp_path / 'python3'
    old.write_text('#!/bin/sh\n[ "$1" = -V ] && echo Python 3.9.1\nexit 1\n')
    old.chmod(0o755)
    done = plan(old)
    assert done.returncode == 1
    assert 'Python 3.10 or later is needed' in done.stderr
    assert 'Python 3.9.1' in done.stderr
    assert len(done.stderr.splitlines()) == 1


# python -m fhaosmo_ros


def test_unknown_command_names_the_closest(capsys):
    assert main(['estimater']) == 2
    message = capsys.readouterr().err
    assert "no command 'estimater'" in message
    assert "did you mean 'estimator'?" in message
    assert all(command in message for command in COMMANDS)
    assert len(message.splitlines()) == 1


@pytest.mark.parametrize('study', ['compare', 'paper'])
def test_study_is_run_by_make(study, capsys):
    assert main([study]) == 2
    assert f'make {study} in a checkout' in capsys.readouterr().err


def test_no_command_lists_all(capsys):
    assert main([]) == 2
    message = capsys.readouterr().err
    assert all(command in message for command in COMMANDS)


@pytest.mark.parametrize('flag', ['-h', '--help'])
def test_help(capsys, flag):
    assert main([flag]) == 0
    message = capsys.readouterr().out
    assert all(command in message for command in COMMANDS)


def test_version(capsys):
    assert main(['--version']) == 0
    assert capsys.readouterr().out == f'fhaosmo_ros {fhaosmo_ros.__version__}\n'


def test_command_gets_its_arguments_and_returns_its_code(monkeypatch):
    fake = ModuleType('fake_command')
    fake.main = len
    monkeypatch.setitem(sys.modules, 'fake_command', fake)
    monkeypatch.setitem(COMMANDS, 'fake', ('fake_command', ''))
    assert main(['fake', 'one', '--two']) == 2


def test_missing_dependency_is_named(monkeypatch, capsys):
    monkeypatch.setitem(COMMANDS, 'fake', ('no_such_module_here', ''))
    assert main(['fake']) == 1
    assert "'no_such_module_here'" in capsys.readouterr().err


def test_module_exit_code():
    done = subprocess.run(
        [sys.executable, '-m', NAME, 'nonsense'], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stdout == ''
