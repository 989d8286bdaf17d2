# SPDX-License-Identifier: Apache-2.0
"""What import-linter cannot see: imports of compiled modules, and what an import really loads."""

import re
import sys

from commands import ROOT, run
import pytest

tomllib = pytest.importorskip('tomllib', reason='Python 3.10 has no tomllib')

PACKAGE = ROOT / 'fhaosmo_ros'
IMPORT = re.compile(r'^\s*(?:from|import|cimport)\s+(fhaosmo_ros[\w.]*)', re.MULTILINE)


def test_compiled_modules_import_only_their_room_and_those_below():
    text = (ROOT / 'pyproject.toml').read_text()
    contracts = tomllib.loads(text)['tool']['importlinter']['contracts']
    [rooms] = [c['layers'] for c in contracts if "core's rooms" in c['name']]
    rooms.append('fhaosmo_ros.core.vectors')
    for path in PACKAGE.rglob('*.p[yx][xd]'):
        room = '.'.join(('fhaosmo_ros', *path.relative_to(PACKAGE).with_suffix('').parts[:2]))
        allowed = rooms[rooms.index(room) :]
        for name in IMPORT.findall(path.read_text()):
            assert '.'.join(name.split('.')[:3]) in allowed, (path, name)


ESTIMATE = """
import sys
from fhaosmo_ros.core import Observer, OnlineEstimator
Observer().step(0.0, 1.0)
OnlineEstimator().advance(1, 0.0)
OnlineEstimator({'gains': 'self_tuning'}).advance(1, 0.0)
print(*{name.split('.')[0] for name in sys.modules})
"""


def test_an_estimate_of_the_default_parameters_loads_nothing_slow():
    loaded = set(run('-c', ESTIMATE, command=[sys.executable]).stdout.split())
    assert 'numpy' in loaded
    assert not loaded & {'scipy', 'skfuzzy', 'networkx', 'matplotlib', 'rclpy', 'rosbags'}
