# SPDX-License-Identifier: Apache-2.0
"""The search itself, on an objective whose minimum is known."""

import math
from pathlib import Path
import sys

from fhaosmo_ros.core import ConfigurationError
import pytest

pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
pytest.importorskip('cmaes', reason='cmaes is not installed (extra: tune)')

from fhaosmo_ros.tools.tuning.search import BAD, Dimension, minimise

ROOT = Path(__file__).resolve().parents[1]
SPACE = [Dimension('a', 1e-3, 1e3, 1.0), Dimension('b', -5.0, 5.0, 0.0, log=False)]


def bowl(values):
    return math.log10(values['a'] / 30.0) ** 2 + (values['b'] - 2.0) ** 2


def seen_by(**options):
    """Return what the search tried, and its result."""
    seen = []
    result = minimise(lambda v: bowl(seen.append(v) or v), SPACE, **options)
    return seen, result


def test_minimum_is_found_from_the_start_on():
    seen, result = seen_by(trials=250)
    assert seen[0] == {'a': 1.0, 'b': 0.0}
    assert len(seen) == result.trials == 250
    assert result.value == bowl(result.best) == min(map(bowl, seen)) < 1e-2


def test_one_job_repeats_itself_and_the_seed_matters():
    runs = [seen_by(trials=20, seed=seed)[0] for seed in (3, 3, 4)]
    assert runs[0] == runs[1] != runs[2]


def test_values_that_are_not_finite_are_bad_not_fatal():
    assert minimise(lambda v: float('nan'), SPACE, 5).value == BAD
    result = minimise(lambda v: bowl(v) if v['b'] < 1.0 else math.inf, SPACE, 60)
    assert result.value < bowl({'a': 1.0, 'b': 0.0})


@pytest.mark.parametrize('jobs', [1, 2])
def test_error_in_the_objective_ends_the_search(jobs):
    with pytest.raises(ZeroDivisionError):
        minimise(lambda v: 1 / 0, SPACE, 50, jobs=jobs)


def test_threads_share_one_study_and_a_stop_keeps_what_there_is():
    done = []
    seen, result = seen_by(trials=1000, jobs=3, on_trial=lambda: len(done.append(0) or done) > 59)
    assert len(seen) == result.trials
    assert 60 <= result.trials <= 62


def test_study_is_continued(tmp_path):
    storage = f'sqlite:///{tmp_path}/study.db'
    first = minimise(bowl, SPACE, 4, storage=storage)
    seen, second = seen_by(trials=7, storage=storage)
    assert (first.trials, len(seen), second.trials) == (4, 3, 7)
    assert second.value <= first.value
    # A study that is complete, and another name, which is another study.
    assert minimise(bowl, SPACE, 5, storage=storage) == second
    assert minimise(bowl, SPACE, 2, storage=storage, name='other').trials == 2


@pytest.mark.parametrize('storage', ['study.log', 'nodb://x', 'sqlite:////no/x.db', 'fails'])
def test_storage_that_fails_is_one_line(tmp_path, storage):
    """At once, or in the middle."""
    file, calls = tmp_path / 'fails.db', []

    def fail_later(values):
        calls.append(values)
        if len(calls) == 5:
            file.write_bytes(b'damaged\n' * 1000)
        return bowl(values)

    storage = f'sqlite:///{file}' if storage == 'fails' else storage
    with pytest.raises(ConfigurationError, match=r'storage.*expected') as error:
        minimise(fail_later, SPACE, 10_000, storage=storage)
    assert '\n' not in str(error.value)
    assert len(calls) <= 6


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'optuna', None)
    with pytest.raises(ConfigurationError, match=r"pip install 'optuna>=4,<6' cmaes"):
        minimise(bowl, SPACE, 1)
