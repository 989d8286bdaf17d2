# SPDX-License-Identifier: Apache-2.0
"""The core, once loaded, has loaded nothing that it may not; the rest is import-linter's."""

from pathlib import Path
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]
CORE = ROOT / 'fhaosmo_ros' / 'core'
FORBIDDEN = ('rclpy', 'rosbags', 'matplotlib', 'optuna', 'fhaosmo_ros.nodes', 'fhaosmo_ros.tools')


def test_core_loads_nothing_that_it_may_not():
    files = [
        path.relative_to(ROOT).with_suffix('')
        for path in (*CORE.rglob('*.py'), *CORE.rglob('*.pyx'))
    ]
    modules = ['.'.join(path.parts).removesuffix('.__init__') for path in files]
    code = f'import sys, {", ".join(modules)}; print(*sys.modules)'
    done = subprocess.run(
        [sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    loaded = set(done.stdout.split())
    assert 'fhaosmo_ros.core.observer.structure' in loaded
    assert loaded.isdisjoint(FORBIDDEN)
