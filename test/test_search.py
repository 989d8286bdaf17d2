# SPDX-License-Identifier: Apache-2.0
"""The search itself, on an objective whose minimum is known; two processes and a kill."""

import math
import os
from pathlib import Path
import signal
import subprocess
import sys

from fhaosmo_ros.core import ConfigurationError
import pytest
from waiting import wait_until

pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
pytest.importorskip('cmaes', reason='cmaes is not installed (extra: tune)')

from fhaosmo_ros.tools.tuning.search import storage as storages
from fhaosmo_ros.tools.tuning.search.minimise import (
    BAD,
    Dimension,
    log_dimensions,
    minimise,
    StudyOptions,
)
from optuna.storages import InMemoryStorage, RDBStorage
import sqlalchemy.exc

ROOT = Path(__file__).resolve().parents[1]
SPACE = [Dimension('a', 1e-3, 1e3, 1.0), Dimension('b', -5.0, 5.0, 0.0, log=False)]


def bowl(values):
    return math.log10(values['a'] / 30.0) ** 2 + (values['b'] - 2.0) ** 2


def test_minimum_is_found():
    result = minimise(bowl, SPACE, 300, jobs=1)
    assert result.value < 1e-3
    assert result.best['a'] == pytest.approx(30.0, rel=0.1)
    assert len(result.trials) == 300
    assert result.trials[0].parameters == {'a': 1.0, 'b': 0.0}
    assert result.failure is None


def test_one_job_repeats_itself_and_the_seed_matters():
    runs = [minimise(bowl, SPACE, 40, StudyOptions(seed), jobs=1).trials for seed in (3, 3, 4)]
    assert runs[0] == runs[1] != runs[2]


def test_threads_share_one_study():
    seen = []
    result = minimise(bowl, SPACE, 120, jobs=3, on_trial=lambda n, best: seen.append((n, best)))
    assert 120 <= len(result.trials) <= 122
    assert [n for n, _ in seen] == sorted(n for n, _ in seen)
    assert seen[-1][1] == result.value < 0.1


def test_values_that_are_not_finite_are_bad_not_fatal():
    result = minimise(lambda v: bowl(v) if v['b'] < 1.0 else float('nan'), SPACE, 60, jobs=1)
    assert result.value < bowl({'a': 1.0, 'b': 0.0})
    assert max(trial.values[0] for trial in result.trials) == BAD


def test_error_in_the_objective_ends_the_search():
    def fail(values):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        minimise(fail, SPACE, 50, jobs=2)


def test_stop_keeps_what_there_is():
    calls = []

    def count(values):
        calls.append(values)
        return bowl(values)

    result = minimise(count, SPACE, 1000, jobs=1, stopped=lambda: len(calls) >= 20)
    assert len(result.trials) == 20


@pytest.mark.parametrize('kind', ['journal', 'sqlite'])
def test_study_is_continued(tmp_path, kind):
    storage = str(tmp_path / 'study.log')
    if kind == 'sqlite':
        storage = f'sqlite:///{storage}'
    first = minimise(bowl, SPACE, 20, StudyOptions(storage=storage), jobs=1)
    second = minimise(bowl, SPACE, 50, StudyOptions(storage=storage), jobs=1)
    assert len(first.trials) == 20
    assert second.trials[:20] == first.trials
    assert len(second.trials) == 50
    assert second.value <= first.value
    # Another name is another study.
    other = minimise(bowl, SPACE, 5, StudyOptions(storage=storage, name='other'), jobs=1)
    assert len(other.trials) == 5


WORKER = """
import sys, time
sys.path.insert(0, 'test')
from test_search import bowl, SPACE
from fhaosmo_ros.tools.tuning.search.minimise import minimise, StudyOptions
calls = 0
def slow(values):
    global calls
    calls += 1
    time.sleep(0.02 if calls <= int(sys.argv[3]) else 3600.0)
    return bowl(values)
result = minimise(slow, SPACE, int(sys.argv[2]), StudyOptions(storage=sys.argv[1]), jobs=1)
print(len(result.trials), result.value)
"""


def worker(storage, trials, calls=1_000_000):
    """Start a search that hangs in the trial after so many."""
    command = [sys.executable, '-c', WORKER, storage, str(trials), str(calls)]
    return subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {'PYTHONPATH': str(ROOT)},
    )


def lines(storage):
    return storage.read_bytes().count(b'\n') if storage.exists() else 0


@pytest.mark.signals
def test_two_processes_and_a_kill(tmp_path):
    """What the killed one had finished stays; the other one ends the study; it goes on later."""
    storage = tmp_path / 'study.log'
    # The victim's trials end by themselves: how late it is killed does not matter.
    victim, other = worker(str(storage), 10_000, calls=40), worker(str(storage), 150)
    try:
        wait_until(lambda: lines(storage) >= 60, 'trials', process=victim)
        assert victim.poll() is None
        victim.send_signal(signal.SIGKILL)
        victim.wait()
        before = lines(storage) - 1  # the first line makes the study
        printed, _ = other.communicate(timeout=60.0)
    finally:
        for process in (victim, other):
            process.kill()
            process.wait()
    count, value = printed.split()
    assert before >= 59
    assert 150 <= int(count) <= 152
    assert float(value) < 0.05
    again = minimise(bowl, SPACE, 160, StudyOptions(storage=str(storage)), jobs=1)
    assert len(again.trials) == 160
    owners = {
        line.split('"worker":"')[1].split('"')[0]
        for line in storage.read_text().splitlines()
        if '"worker":"' in line
    }
    assert len(owners) == 3


def test_line_cut_short_by_a_kill_is_cut_off(tmp_path):
    storage = tmp_path / 'study.log'
    minimise(bowl, SPACE, 10, StudyOptions(storage=str(storage)), jobs=1)
    with storage.open('ab') as file:
        file.write(b'{"op_code":4,"wor')
    assert len(minimise(bowl, SPACE, 20, StudyOptions(storage=str(storage)), jobs=1).trials) == 20


@pytest.mark.parametrize('storage', [None, 'study.log'])
def test_notes_are_kept_and_only_the_first_number_is_minimised(tmp_path, storage):
    def noted(values):
        return bowl(values), values['b'], -1e6 * values['a']

    if storage is not None:
        storage = str(tmp_path / storage)
    result = minimise(noted, SPACE, 100, StudyOptions(storage=storage), jobs=1)
    assert result.value < 0.1
    for trial in result.trials:
        values = trial.parameters
        assert trial.values == (bowl(values), values['b'], -1e6 * values['a'])


@pytest.mark.parametrize(
    ('space', 'message'),
    [
        ([], 'at least one dimension'),
        ([Dimension('a', 2.0, 1.0, 1.5)], "'a'.*lower one first"),
        ([Dimension('a', 1.0, 2.0, 3.0)], "'a'.*start from 1.0 to 2.0, got 3.0"),
        ([Dimension('a', 0.0, 2.0, 1.0)], "'a'.*bounds > 0"),
        ([Dimension('a', 0.0, float('inf'), 1.0)], "'a'.*finite"),
    ],
)
def test_bad_space_is_one_line(space, message):
    with pytest.raises(ConfigurationError, match=message):
        minimise(bowl, space, 1)


@pytest.mark.parametrize(
    'storage', ['/no/such/folder/study.log', 'nodb://x', 'sqlite:////no/x.db']
)
def test_bad_storage_is_one_line(storage):
    with pytest.raises(ConfigurationError, match=r'storage.*expected') as error:
        minimise(bowl, SPACE, 1, StudyOptions(storage=storage))
    assert '\n' not in str(error.value)


@pytest.mark.parametrize(
    ('installed', 'url', 'opened'),
    [
        ({'psycopg', 'psycopg2'}, 'postgresql://u@h/db', 'postgresql+psycopg://u@h/db'),
        ({'psycopg2', 'pg8000'}, 'postgresql://u@h/db', 'postgresql+psycopg2://u@h/db'),
        ({'pg8000'}, 'postgresql://u@h/db', 'postgresql+pg8000://u@h/db'),
        ({'psycopg'}, 'postgresql+pg8000://u@h/db', 'postgresql+pg8000://u@h/db'),
    ],
)
def test_postgresql_is_opened_by_the_driver_that_is_installed(monkeypatch, installed, url, opened):
    urls = []
    _install(monkeypatch, installed)
    monkeypatch.setattr(storages, 'RDBStorage', lambda url: urls.append(url) or InMemoryStorage())
    storages.open_study(url, 'study')
    assert urls == [opened]


def test_postgresql_without_a_driver_says_what_to_install(monkeypatch):
    _install(monkeypatch, set())
    with pytest.raises(ConfigurationError, match=r'psycopg2, pg8000.*pip install') as error:
        storages.open_study('postgresql://u@h/db', 'study')
    assert '\n' not in str(error.value)


def _install(monkeypatch, drivers):
    def import_module(name):
        if name not in drivers:
            raise ImportError(name)

    monkeypatch.setattr(storages, 'import_module', import_module)


def test_tables_that_another_process_creates_are_waited_for(tmp_path, monkeypatch):
    errors = [
        sqlalchemy.exc.OperationalError('', {}, Exception('table studies already exists')),
        sqlalchemy.exc.IntegrityError('', {}, Exception('UNIQUE constraint failed: alembic')),
    ]

    def open_(url):
        if errors:
            raise errors.pop()
        return RDBStorage(url)

    monkeypatch.setattr(storages, 'PAUSE', 0.0)
    monkeypatch.setattr(storages, 'RDBStorage', open_)
    options = StudyOptions(storage=f'sqlite:///{tmp_path}/study.db')
    assert len(minimise(bowl, SPACE, 3, options, jobs=1).trials) == 3
    assert not errors


@pytest.mark.parametrize('kind', ['journal', 'sqlite'])
def test_storage_that_fails_in_the_middle_keeps_the_trials(tmp_path, kind):
    file = tmp_path / 'study'
    calls = []

    def fail_later(values):
        calls.append(values)
        if len(calls) == 30:
            file.write_bytes(b'damaged\n' * 1000)
        return bowl(values)

    options = StudyOptions(storage=str(file) if kind == 'journal' else f'sqlite:///{file}')
    result = minimise(fail_later, SPACE, 10_000, options, jobs=2)
    assert result.failure
    assert '\n' not in result.failure
    assert 30 <= len(calls) == len(result.trials) < 10_000
    assert result.value == min(map(bowl, calls))


@pytest.mark.parametrize('line', [b'{"op_code":4,"wor\xff', b'12', b'', b'{}'])
def test_bad_line_of_a_journal_is_named(tmp_path, line):
    storage = tmp_path / 'study.log'
    minimise(bowl, SPACE, 10, StudyOptions(storage=str(storage)), jobs=1)
    lines = storage.read_bytes().splitlines()
    lines[4] = line
    storage.write_bytes(b'\n'.join([*lines, b'']))
    with pytest.raises(ConfigurationError, match=r'study\.log: line 5: .*journal') as error:
        minimise(bowl, SPACE, 20, StudyOptions(storage=str(storage)), jobs=1)
    assert '\n' not in str(error.value)
    assert 'URL' not in str(error.value)


def test_log_dimensions():
    (d,) = log_dimensions({'q': 2.0}, decades=1.0)
    assert d == Dimension('q', 0.2, 20.0, 2.0, True)
