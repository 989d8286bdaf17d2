# SPDX-License-Identifier: Apache-2.0
"""Who may import what: dependencies point from nodes and tools to the core, never back."""

import ast
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'fhaosmo_ros'

# What: where it may be imported (folders end with /).
ALLOWED = {
    'rclpy': ['nodes/'],
    'rosbags': ['tools/bags.py', 'tools/bag_reader.py', 'tools/bag_writer.py'],
    'control': ['tools/sampled_model.py'],
    'matplotlib': [
        'tools/comparison/figures.py',
        'tools/figures.py',
        'tools/paper_figures.py',
        'tools/tuning/figures.py',
    ],
    'optuna': ['tools/tuning/search.py', 'tools/tuning/study.py'],
    'skfuzzy': ['core/fuzzy.py'],
}
FORBIDDEN_IN_CORE = [
    'rclpy',
    'rosbags',
    'matplotlib',
    'optuna',
    'fhaosmo_ros.nodes',
    'fhaosmo_ros.tools',
]


def imports(source, module):
    """Return the absolute names of all modules that `source`, itself `module`, may import."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parent = module.split('.')[: -node.level] if node.level else []
            base = '.'.join([*parent, *([node.module] if node.module else [])])
            names += [base, *(f'{base}.{alias.name}' for alias in node.names)]
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func).rsplit('.', 1)[-1]
            if name in ('import_module', '__import__') and node.args:
                target = node.args[0]
                names.append(target.value if isinstance(target, ast.Constant) else '?')
    return names


def violations(source, path):
    """Return the imports of the file `path` (within the package) that break the rules."""
    module = 'fhaosmo_ros.' + path.removesuffix('.py').replace('/', '.')
    found = []
    for name in imports(source, module):
        forbidden = FORBIDDEN_IN_CORE if path.startswith('core/') else []
        forbidden = [*forbidden, *(k for k, v in ALLOWED.items() if not path.startswith(tuple(v)))]
        if any(name == f or name.startswith(f'{f}.') for f in forbidden):
            found.append(name)
    return found


FILES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob('*.py'))


@pytest.mark.parametrize('path', FILES)
def test_file_imports_only_what_it_may(path):
    assert violations((PACKAGE / path).read_text(encoding='utf-8'), path) == []


@pytest.mark.parametrize(
    ('path', 'source'),
    [
        ('core/observer.py', 'import rclpy'),
        ('core/observer.py', 'import rclpy.node as n'),
        ('core/observer.py', 'from rclpy.node import Node'),
        ('core/observer.py', 'def f():\n    import rosbags.highlevel'),
        ('core/observer.py', 'if TYPE_CHECKING:\n    import matplotlib'),
        ('core/observer.py', 'from fhaosmo_ros import nodes'),
        ('core/observer.py', 'from fhaosmo_ros.tools.bags import read'),
        ('core/observer.py', 'from .. import tools'),
        ('core/observer.py', 'from ..nodes import parameters'),
        ('core/observer.py', 'from ..nodes.parameters import declare'),
        ('core/observer.py', "importlib.import_module('rclpy')"),
        ('core/observer.py', "__import__('rclpy')"),
        ('core/observer.py', 'import skfuzzy'),
        ('tools/demo.py', 'import rclpy'),
        ('tools/demo.py', 'from matplotlib import pyplot'),
        ('tools/figures.py', 'from rosbags.rosbag2 import Reader'),
        ('nodes/estimator.py', 'import rosbags'),
        ('__main__.py', 'import rclpy'),
    ],
)
def test_planted_import_is_caught(path, source):
    assert len(violations(source, path)) >= 1


@pytest.mark.parametrize(
    ('path', 'source'),
    [
        ('core/fuzzy.py', 'import skfuzzy'),
        ('core/observer.py', 'from fhaosmo_ros.core import kernels'),
        ('core/observer.py', 'from . import kernels'),
        ('core/observer.py', 'import rclpython'),
        ('core/observer.py', "text = 'import rclpy'"),
        ('nodes/estimator.py', 'from rclpy.node import Node'),
        ('nodes/estimator.py', 'from fhaosmo_ros.core import Observer'),
        ('tools/bags.py', 'from rosbags.rosbag2 import Reader'),
        ('tools/figures.py', 'import matplotlib.pyplot'),
    ],
)
def test_allowed_import_is_let_through(path, source):
    assert violations(source, path) == []


def test_core_loads_nothing_that_it_may_not():
    files = [p.removesuffix('.py').removesuffix('/__init__') for p in FILES]
    modules = ['fhaosmo_ros.' + p.replace('/', '.') for p in files if p.split('/')[0] == 'core']
    code = f'import sys, {", ".join(modules)}'
    done = subprocess.run(
        [sys.executable, '-c', f'{code}; print(*sys.modules)'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(done.stdout.split())
    assert 'fhaosmo_ros.core.kernels' in loaded
    for name in FORBIDDEN_IN_CORE:
        assert name not in loaded
