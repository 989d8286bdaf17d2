# SPDX-License-Identifier: Apache-2.0
"""
One Optuna study, shared by threads, processes and machines, at a thousandth of a second a trial.

Each process proposes its trials in memory (a proposal written to a file or data base parameter by
parameter costs tens of milliseconds, more than an evaluation). A finished trial is published as
one record, with what the sampler notes beside it, and those of the other processes are taken into
memory the same way. So all share one CMA-ES state; a process that is killed takes only the trials
that it was running with it; a study goes on where it was left, by however many processes.
"""

from collections.abc import Callable, Mapping, Sequence
import fcntl
import os
from pathlib import Path
import socket
from threading import Lock
import time
from typing import NamedTuple
import uuid

from fhaosmo_ros.core.errors import ConfigurationError
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler
from optuna.storages import BaseStorage, InMemoryStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

EXCHANGE = 0.1
"""Seconds between two looks at what the others have published."""
WINDOW = 1000
"""Trials that stay in the proposing memory: a sampler's cost grows with them."""
WORKER, NOTES = 'worker', 'notes'
"""What is kept with a trial."""


class Point(NamedTuple):
    """
    A finished trial.

    Attributes
    ----------
    parameters : dict
    values : tuple of float
        The objective, and what was noted beside it.

    """

    parameters: dict[str, float]
    values: tuple[float, ...]


class Desk:
    """
    Hands trials out and takes them back; safe to use from several threads.

    Parameters
    ----------
    make_sampler : callable
        From a number that differs between the processes that share the study, 0 for the one that
        began it.
    distributions : mapping
        Of the parameters, by name.
    storage : str or None
        See `open_storage`.
    name : str
        Of the study.

    """

    def __init__(
        self,
        make_sampler: Callable[[int], BaseSampler],
        distributions: Mapping[str, BaseDistribution],
        storage: str | None,
        name: str,
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._distributions = dict(distributions)
        self._worker = f'{socket.gethostname()}:{os.getpid()}:{uuid.uuid4().hex[:8]}'
        self._memory, self._publishing = Lock(), Lock()
        self._read, self._count, self._best = 0, 0, float('inf')
        self._looked, self._running = 0.0, 0
        self._shared, begun = _open_study(open_storage(storage), name)
        self._sampler = make_sampler(0 if begun else 1 + uuid.uuid4().int % 2**30)
        self._study = self._proposing([])
        with self._publishing:
            self._exchange()

    @property
    def count(self) -> int:
        """Finished trials in the study, as far as is known here."""
        return self._count

    @property
    def begun(self) -> int:
        """As `count`, with the trials that run here."""
        return self._count + self._running

    def ask(self, fixed: dict[str, float] | None = None) -> Trial:
        """Return a trial to evaluate; `fixed` gives its parameters."""
        with self._publishing:
            self._running += 1
            if time.monotonic() - self._looked > EXCHANGE:
                self._exchange()
        with self._memory:
            kept = self._study.get_trials(deepcopy=False)
            if len(kept) > 2 * WINDOW:
                finished = [trial for trial in kept[-WINDOW:] if trial.state.is_finished()]
                self._study = self._proposing(finished)
            if fixed is not None:
                self._study.enqueue_trial(fixed)
            trial = self._study.ask(self._distributions)
            trial.set_user_attr(WORKER, self._worker)
            return trial

    def tell(self, trial: Trial, value: float, notes: Sequence[float] = ()) -> None:
        """Take a trial's value and what to keep beside it, and publish it."""
        with self._memory:
            trial.set_user_attr(NOTES, list(notes))
            done = trial.study.tell(trial, value)
            if trial.study is not self._study:  # begun before the memory was renewed
                self._study.add_trial(done)
        with self._publishing:
            self._shared.add_trial(done)
            self._count += 1
            self._running -= 1
            self._best = min(self._best, value)

    def report(self, listener: Callable[[int, float], None]) -> None:
        """Call with the number of finished trials and the best value; one at a time."""
        with self._publishing:
            listener(self._count, self._best)

    def points(self) -> list[Point]:
        """Return the study's finished trials in order."""
        with self._publishing:
            finished = self._shared.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        return [
            Point(dict(trial.params), (trial.value or 0.0, *trial.user_attrs.get(NOTES, ())))
            for trial in finished
        ]

    def _proposing(self, trials: list[FrozenTrial]) -> optuna.Study:
        study = optuna.create_study(storage=InMemoryStorage(), sampler=self._sampler)
        study.add_trials(trials)
        return study

    def _exchange(self) -> None:
        """Take what the others have published into memory."""
        trials = self._shared.get_trials(deepcopy=False)
        new = [t for t in trials[self._read :] if t.user_attrs.get(WORKER) != self._worker]
        self._read = self._count = len(trials)
        if new:
            self._best = min(self._best, *(trial.value or 0.0 for trial in new))
            with self._memory:
                self._study.add_trials(new[-WINDOW:])
        self._looked = time.monotonic()


class _FileLock:
    """
    A lock that the system gives up for a process that is killed.

    Optuna's own locks stay then, and stop everybody for half a minute. Whoever takes it also cuts
    off a line that a killed process left unfinished: the next one would be glued to it.
    """

    def __init__(self, journal: Path) -> None:
        self._journal = journal
        self._lock = journal.with_name(journal.name + '.lock')

    def acquire(self) -> bool:
        """Wait for the lock."""
        self._file = self._lock.open('ab')
        fcntl.flock(self._file, fcntl.LOCK_EX)
        with self._journal.open('rb+') as file:
            size = file.seek(0, os.SEEK_END)
            if size:
                file.seek(size - 1)
                if file.read(1) != b'\n':
                    file.seek(0)
                    file.truncate(file.read().rfind(b'\n') + 1)
        return True

    def release(self) -> None:
        """Give it up."""
        self._file.close()


def open_storage(text: str | None) -> BaseStorage:
    """
    Return a storage: in memory, a data base at a URL, or a journal file.

    Raises
    ------
    ConfigurationError
        It can't be opened.

    """
    if text is None:
        return InMemoryStorage()
    try:
        if '://' in text and not text.startswith('journal://'):
            return optuna.storages.RDBStorage(text)
        path = Path(text.removeprefix('journal://'))
        return JournalStorage(JournalFileBackend(str(path), _FileLock(path)))
    except Exception as error:  # SQLAlchemy's and each driver's own kinds
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise ConfigurationError(
            f'storage {text!r}: expected a file to write a journal to, or the URL of a data base '
            f'such as sqlite:///study.db, got: {reason[:200]}'
        ) from None


def _open_study(storage: BaseStorage, name: str) -> tuple[optuna.Study, bool]:
    """Return the study of this name, and whether it was made now."""
    try:
        return optuna.create_study(storage=storage, study_name=name), True
    except optuna.exceptions.DuplicatedStudyError:
        return optuna.load_study(storage=storage, study_name=name), False
