# SPDX-License-Identifier: Apache-2.0
"""The benchmark measures what it says; how fast is for `make bench` to tell."""

import importlib
import json
from pathlib import Path
import shutil
import subprocess
import sys

from fhaosmo_ros.core.observer.status import open_levels
import numpy as np
import pytest

BENCHMARK = Path(__file__).resolve().parents[1] / 'benchmark'


@pytest.fixture(name='reference')
def _reference(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARK)
    module = importlib.import_module('reference')
    try:
        module.find_compiler()
    except importlib.import_module('table').CannotMeasureError as error:
        pytest.skip(str(error))
    return module


def test_c_reference_takes_the_same_steps(reference, tmp_path):
    """So that the ratio compares equal work, with all levels open and gamma moving."""
    y = reference.output(20_001)
    reference.assert_agreement(reference.compile_reference(tmp_path), y)
    state, word = reference.in_core(reference.CASE, y)()
    assert open_levels(word) == 4
    assert not np.isclose(state[16], 0.5)


def test_disagreement_is_noticed(reference, tmp_path, monkeypatch):
    monkeypatch.setattr(reference, 'CASE', reference.CASE | {'gamma_rate': 0.004})
    library = reference.compile_reference(tmp_path)
    other = reference.CASE | {'gamma_rate': 0.0041}
    in_core = reference.in_core
    monkeypatch.setattr(reference, 'in_core', lambda _, y: in_core(other, y))
    with pytest.raises(AssertionError):
        reference.assert_agreement(library, reference.output(2_001))


def test_missing_compiler_is_one_line(reference, monkeypatch):
    monkeypatch.setenv('CC', 'no-such-compiler')
    with pytest.raises(Exception, match=r"no C compiler 'no-such-compiler'.*set CC$"):
        reference.find_compiler()


@pytest.mark.skipif(shutil.which('cc') is None, reason='no C compiler (cc)')
def test_quick_core():
    done = subprocess.run(
        [sys.executable, BENCHMARK / 'run.py', '--quick', '--only', 'core'],
        capture_output=True, text=True, cwd=BENCHMARK.parent, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    page = json.loads((BENCHMARK.parent / 'docs' / 'speed.json').read_text())
    for row in page['core']['rows']:
        assert row['name'] in done.stdout


@pytest.mark.ros
def test_quick_rates():
    pytest.importorskip('rclpy')
    done = subprocess.run(
        [sys.executable, BENCHMARK / 'run.py', '--quick', '--only', 'rates'],
        capture_output=True, text=True, cwd=BENCHMARK.parent, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert 'CPU, estimator / empty node, y 1000 Hz, estimates 1000 Hz' in done.stdout
    table = [line.split() for line in done.stdout.splitlines() if line.startswith('1000  ')]
    assert [line[3] for line in table] == ['estimator', 'empty']
    for line in table:
        cpu, lost, sent, *times = (float(word.replace(',', '')) for word in line[4:])
        assert cpu > 0
        assert 0 <= lost < sent
        assert all(time > 0 for time in times)


def test_quick_tune():
    pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
    done = subprocess.run(
        [sys.executable, BENCHMARK / 'run.py', '--quick', '--only', 'tune'],
        capture_output=True, text=True, cwd=BENCHMARK.parent, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert 'trials a minute' in done.stdout
    assert 'efficiency' in done.stdout


def test_rows_without_value_miss_their_bar(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARK)
    table = importlib.import_module('table')
    nan = float('nan')
    missed = [table.Row('x', value, bar=1.5).missed for value in (1.4, 1.6, None, nan)]
    assert missed == [False, True, True, True]
    assert not table.Row('x', None).missed
    assert 'MISSED' in table.render([table.Row('x', 2.0, bar=1.5)])
