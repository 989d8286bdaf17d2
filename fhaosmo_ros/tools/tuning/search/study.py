# SPDX-License-Identifier: Apache-2.0
"""
One Optuna study, shared by threads, processes and machines, at a thousandth of a second a trial.

Each process lets the sampler propose its trials in memory: a proposal that is written to a file
or data base parameter by parameter costs tens of milliseconds, more than an evaluation. A finished
trial is published as one record, together with the sampler's own notes, and each process reads the
records of the others into its memory. So all processes share one CMA-ES state. A process that is
killed loses only the trials that it was running, and any number of processes can continue a study.
If the storage fails in the middle, the trials that this process knows stay in its memory.
"""

from collections.abc import Callable, Mapping, Sequence
import os
import socket
from threading import Lock
import time
from typing import NamedTuple, TypeVar
import uuid

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.tuning.search.storage import one_line, open_study
import optuna
from optuna.distributions import BaseDistribution
from optuna.samplers import BaseSampler
from optuna.storages import InMemoryStorage
from optuna.trial import FrozenTrial, Trial, TrialState

SYNCHRONISED_EVERY = 0.1
"""Seconds between two reads of what the other processes have published."""
REMEMBERED = 1000
"""Trials that the sampler remembers: the cost of a proposal grows with them."""
WORKER, NOTES = 'worker', 'notes'
"""Names of the attributes that are stored with a trial."""


Result = TypeVar('Result')


class FinishedTrial(NamedTuple):
    """
    A finished trial of a study.

    Attributes
    ----------
    parameters : dict
    values : tuple of float
        The objective, then the numbers that were stored with it.

    """

    parameters: dict[str, float]
    values: tuple[float, ...]


class SharedStudy:
    """
    Gives out trials and takes their results (`ask` and `tell`); several threads may use it.

    Parameters
    ----------
    make_sampler : callable
        Returns a sampler for a number: 0 in the process that made the study, another random
        number in each process that joins it.
    distributions : mapping
        Of the parameters, by name.
    storage : str or None
        See `open_study`.
    name : str
        Of the study.

    Attributes
    ----------
    failure : str or None
        Why the storage can't be used any more.

    Raises
    ------
    ConfigurationError
        A storage that can't be used.

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
        self._proposing, self._publishing = Lock(), Lock()
        self._known: list[FrozenTrial] = []
        self._read, self._best = 0, float('inf')
        self._synchronised_at, self._running = 0.0, 0
        self.failure: str | None = None
        self._shared, made = open_study(storage, name)
        self._sampler = make_sampler(0 if made else 1 + uuid.uuid4().int % 2**30)
        self._study = self._in_memory([])
        with self._publishing:
            self._synchronise()
        if self.failure:
            raise ConfigurationError(f'storage {storage!r}: {self.failure}')

    @property
    def count(self) -> int:
        """Finished trials in the study, as far as this process knows."""
        return len(self._known)

    @property
    def started(self) -> int:
        """Finished trials, and the trials that run in this process."""
        return self.count + self._running

    def ask(self, fixed: dict[str, float] | None = None) -> Trial:
        """Return a trial to evaluate; `fixed` gives its parameters."""
        with self._publishing:
            self._running += 1
            if time.monotonic() - self._synchronised_at > SYNCHRONISED_EVERY:
                self._synchronise()
        with self._proposing:
            known = self._study.get_trials(deepcopy=False)
            if len(known) > 2 * REMEMBERED:
                finished = [trial for trial in known[-REMEMBERED:] if trial.state.is_finished()]
                self._study = self._in_memory(finished)
            if fixed is not None:
                self._study.enqueue_trial(fixed)
            trial = self._study.ask(self._distributions)
            trial.set_user_attr(WORKER, self._worker)
            return trial

    def tell(self, trial: Trial, value: float, notes: Sequence[float] = ()) -> None:
        """Take the value of a trial and the numbers to store with it, and publish them."""
        with self._proposing:
            trial.set_user_attr(NOTES, list(notes))
            done = trial.study.tell(trial, value)
            if trial.study is not self._study:  # asked before the study in memory was renewed
                self._study.add_trial(done)
        with self._publishing:
            self._known.append(done)
            self._running -= 1
            self._best = min(self._best, value)
            self._try(lambda: self._shared.add_trial(done))

    def report(self, listener: Callable[[int, float], None]) -> None:
        """Call with the number of finished trials and the best value; one thread at a time."""
        with self._publishing:
            listener(self.count, self._best)

    def finished(self) -> list[FinishedTrial]:
        """Return the finished trials in the order in which this process learnt of them."""
        with self._publishing:
            self._synchronise()
            finished = [trial for trial in self._known if trial.state is TrialState.COMPLETE]
        return [
            FinishedTrial(
                dict(trial.params), (trial.value or 0.0, *trial.user_attrs.get(NOTES, ()))
            )
            for trial in finished
        ]

    def _in_memory(self, trials: list[FrozenTrial]) -> optuna.Study:
        study = optuna.create_study(storage=InMemoryStorage(), sampler=self._sampler)
        study.add_trials(trials)
        return study

    def _synchronise(self) -> None:
        """Read what the other processes have published into memory."""
        trials = self._try(lambda: self._shared.get_trials(deepcopy=False))
        if trials is None:
            return
        new = [t for t in trials[self._read :] if t.user_attrs.get(WORKER) != self._worker]
        self._known += new
        self._read = len(trials)
        if new:
            self._best = min(self._best, *(trial.value or 0.0 for trial in new))
            with self._proposing:
                self._study.add_trials(new[-REMEMBERED:])
        self._synchronised_at = time.monotonic()

    def _try(self, use: Callable[[], Result]) -> Result | None:
        """Use the storage; if it fails, note why and do not use it again."""
        if self.failure is None:
            try:
                return use()
            except Exception as error:  # SQLAlchemy and each driver have exceptions of their own
                self.failure = one_line(error)
        return None
