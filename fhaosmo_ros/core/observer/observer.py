# SPDX-License-Identifier: Apache-2.0
"""The observer: one sample at a time, or arrays of samples, by the same compiled recursion."""

from collections.abc import Mapping
from contextlib import suppress
import math
from pathlib import Path
from typing import Any
import warnings

from fhaosmo_ros.core.model.inputs import known_inputs, samples_of_run
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.cascade import Cascade
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory, Tuning
from fhaosmo_ros.core.observer.levant import Levant
from fhaosmo_ros.core.observer.self_tuning.observer import SelfTuning
from fhaosmo_ros.core.observer.smoother import Smoother
from fhaosmo_ros.core.observer.status import REJECTED
from fhaosmo_ros.core.observer.structure import run
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import make_from_file
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, OBSERVER_PARAMETERS
import numpy as np
from numpy.typing import ArrayLike, NDArray

OF_PAPER = 'lambda', 'alpha', 'fuzzy_widths'


def make_structure(configuration: ObserverConfiguration) -> Any:
    """Return the observer that a configuration asks for, before its first sample."""
    if configuration.self_tuning:
        return SelfTuning(configuration)
    return Levant(configuration) if configuration.levant else Cascade(configuration)


class Observer:
    """
    Fuzzy-based super-twisting adaptive-order sliding mode observer.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the parameters in docs/parameters.md; defaults for the rest. Those of the
        estimator that are not the observer's are checked and left out, so that it takes what
        `tune` has written. `Parameters` have been checked and are taken as they are.
    **named
        Parameters as keyword arguments, which win; ``lambda_`` for ``lambda``.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    Warns
    -----
    UserWarning
        The gains are the default ones, for the paper's plant, and phi is of another plant.

    Examples
    --------
    >>> observer = Observer(order=2, phi=['0', '-k*z2'], constants={'k': 3}, gains='self_tuning')
    >>> observer.start(0.1).z
    array([0.1, 0. ])
    >>> observer.step(0.1, dt=0.001).status
    <Status.OK: 0>

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None, /, **named: Any) -> None:
        given = ESTIMATOR_PARAMETERS.complete(parameters, named)
        self.structure = make_structure(ObserverConfiguration(given))
        told = {p.name for p in OBSERVER_PARAMETERS.values() if given[p.name] != p.default}
        if 'phi' in told and told.isdisjoint({'gains', *OF_PAPER}):
            warnings.warn(
                "the default gains are for the paper's plant, and phi is of another one: set "
                f'gains to self_tuning, or find {", ".join(OF_PAPER)} with the command tune',
                stacklevel=2,
            )
        self._t: float | int | None = None

    def __repr__(self) -> str:
        return f'Observer(order={self.order}, phi={list(self.model.phi)}: {self.description})'

    @classmethod
    def from_yaml(cls, path: str | Path, node: str = 'estimator', channel: str = '') -> 'Observer':
        """
        Return one with the parameters of a file for ROS, such as the `gains.yaml` of `tune`.

        Parameters
        ----------
        path : path
            A YAML file of the form ``estimator: {ros__parameters: {...}}``.
        node : str
            Whose sections to take, such as '/rig/estimator'.
        channel : str
            Name of the channel, of a node that has several.

        Raises
        ------
        ConfigurationError
            As the constructor, or a file that can't be used; the message begins with its path.

        """
        return make_from_file(cls, path, node, channel)

    @property
    def configuration(self) -> ObserverConfiguration:
        """Its parameters, checked as a set, and what follows from them."""
        return self.structure.configuration  # type: ignore[no-any-return]

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters with their present values; a copy."""
        return dict(self.configuration.parameters)

    @property
    def order(self) -> int:
        """Number of states n."""
        return self.model.order

    @property
    def levels(self) -> int:
        """Number of levels N."""
        return self.configuration.levels

    @property
    def self_tuning(self) -> bool:
        """True if it finds its gains by itself."""
        return self.configuration.self_tuning

    @property
    def description(self) -> str:
        """What runs, in words."""
        c = self.configuration
        if c.self_tuning:
            return 'self-tuning: a bank of Kalman filters'
        structure = 'Levant' if c.levant else 'super-twisting cascade'
        power = 'adaptive power' if c.adaptive and c.parameters['gamma_rate'] > 0.0 else 'power'
        scheme = 'predict_correct' if c.levant else c.parameters['scheme']
        curve = 'sign' if c.is_sign else 'fuzzy'
        return f'{structure}, {curve}, {power} {c.gamma_initial:g}, {scheme}'

    @property
    def model(self) -> TriangularModel:
        """Phi, and the names of the known inputs."""
        return self.configuration.model

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the known inputs, in the order of their values."""
        return self.model.inputs

    @property
    def used_inputs(self) -> tuple[str, ...]:
        """Names of those of them that the model uses."""
        return self.model.used_inputs

    @property
    def standard_deviation(self) -> NDArray[np.float64]:
        """
        Standard deviations of the errors of z and d, (n + 1,), as a self-tuning observer expects.

        Infinite before it knows the noise; NaN for an observer with fixed gains.
        """
        variances: NDArray[np.float64] = self.structure.variances
        return np.sqrt(variances)

    @property
    def tuning(self) -> Tuning:
        """What a self-tuning observer has found; NaN before it knows the noise."""
        return Tuning.of(self.structure.found)

    @property
    def started(self) -> bool:
        """True once a sample has arrived."""
        return not math.isnan(self.structure.memory['y'])

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change parameters from the next sample on, without a jump of the estimate.

        All or nothing: where anything is wrong, nothing has changed.

        Raises
        ------
        ConfigurationError
            As the constructor, or a change of a parameter that fixes the observer's size.

        """
        parameters = self.configuration.parameters.changed_live(changes, 'observer')
        self.adopt(ObserverConfiguration(parameters))

    def adopt(self, configuration: ObserverConfiguration) -> None:
        """Go on with a configuration of the same model and size, from the next sample on."""
        structure = make_structure(configuration)
        remembered = self.structure.state_dict() | configuration.forgotten(self.configuration)
        with suppress(ConfigurationError):  # where numbers have overflowed it begins afresh
            structure.load_state_dict(remembered)
        structure.word = self.structure.word
        self.structure = structure

    def reset(self) -> None:
        """Go back to the initial state; the next sample is the first."""
        self.structure.forget()
        self._t = None

    def start(self, y: float) -> Estimate:
        """Take the first sample: time has not passed yet, so nothing is integrated."""
        return self.structure.begin(y)

    def step(self, y: float, dt: float, u: ArrayLike | None = None) -> Estimate:
        """
        Advance by `dt` to the sample `y`.

        The explicit scheme integrates over the interval with the sample at its beginning, as
        forward Euler does, so that `y` acts from the next step on; the implicit scheme uses `y`.

        Parameters
        ----------
        y : float
            Measured output at the end of the interval.
        dt : float
            Time since the previous call, in seconds, > 0.
        u : number or (m,) array, optional
            Known input, or known inputs, during the interval; needed where phi uses one.

        Returns
        -------
        Estimate
            A bad sample does not raise: `Estimate.status` says what was rejected, the state stays
            as it was, and the time of a rejected sample is added to the next step (see `Status`).

        Raises
        ------
        ConfigurationError
            A `dt` that is not > 0 and finite, or u is missing or of another shape.

        """
        if not 0.0 < dt < math.inf:
            raise ConfigurationError(f'step: expected dt > 0 and finite, in seconds, got {dt}')
        if u is None:
            u = self._no_input()
        return self.structure.update(y, dt, u)

    @property
    def estimate(self) -> Estimate:
        """Estimate of the present state, with the status of the last step."""
        return self.structure.report()

    def run(self, t: ArrayLike, y: ArrayLike, u: ArrayLike | None = None) -> Trajectory:
        """
        Step through arrays; the state goes on from where it is, so a run can be split.

        Parameters
        ----------
        t : (K,) array
            Sample times, in seconds, or in nanoseconds if integers, or datetime64; they increase.
            Columns of a table, (K, 1), are taken as well, of this and the others.
        y : (K,) array
            Samples; NaN, or a mask, stands for a missing one.
        u : number, (K,) or (K, m) array, optional
            Known input, or known inputs, during the interval that ends at each sample; needed
            where phi uses one.

        Returns
        -------
        Trajectory
            Row k is the estimate after sample k. A fresh observer takes the first sample as
            `start` does, else time goes on from the last run's last sample.

        Raises
        ------
        ConfigurationError
            Arrays whose shapes do not fit, times that do not increase, or u that is missing.

        """
        t, y = samples_of_run(t, y)
        u = known_inputs(self._no_input() if u is None else u, self.inputs, len(y))
        h = intervals(t, self._t if self.started else None)
        if len(t):
            self._t = t[-1].item()
        return Trajectory(t, **run(self.structure, y, h, u).columns)

    def smooth(self, t: ArrayLike, y: ArrayLike, u: ArrayLike | None = None) -> Trajectory:
        """
        Estimate each time from the samples before and after it (D 24, D 25).

        A fresh observer goes forward through the samples; this one stays as it is. A sample that
        it rejects (NaN stands for a missing one) does not count, and its time is bridged by those
        on both sides. Nothing is smoothed across a restart.

        Parameters
        ----------
        t, y, u
            As in `run`.

        Returns
        -------
        Trajectory
            A row for each sample, with `z`, `unknown_input` and `standard_deviation` smoothed; the
            rest as `run` has it.

        Raises
        ------
        ConfigurationError
            As `run`; or gains are fixed and `noise_size` is 0, which says how much to trust a
            sample.

        """
        observer = Observer(self.configuration.parameters)
        found = observer.run(t, y, u)
        if not observer.started:
            return found
        first = int(np.argmax((found.status & REJECTED) == 0))
        u = known_inputs(0.0 if u is None else u, self.inputs, len(found.t))
        for k in np.flatnonzero(~np.isfinite(u).all(axis=1)).tolist():  # the last ones are held
            u[k] = u[max(k - 1, first)]
        smoother = Smoother(observer, every=True)
        due = smoother.take(found.rows(slice(first, None)), found.t[first:], u[first:])
        for rows in (due, smoother.finish()):
            first, begin = first + len(rows.t), first
            for name in ('z', 'unknown_input', 'standard_deviation'):
                getattr(found, name)[begin:first] = getattr(rows, name)
        return found

    def _no_input(self) -> float:
        """Return what stands for known inputs that were not given, or raise where phi has one."""
        if self.used_inputs:
            raise ConfigurationError(
                f'u: expected values of {", ".join(self.used_inputs)}, which phi uses, got none'
            )
        return 0.0


def intervals(t: NDArray[Any], start: float | int | None) -> NDArray[np.float64]:
    """
    Return the time (s) of each sample since the one before it, or raise unless times increase.

    Times are as those of `run`; `start` is that before the first one, whose interval is 0 without.
    """
    before = np.concatenate([t[:1] if start is None else np.array([start], t.dtype), t[:-1]])
    h = t - before
    good = (h > 0) & np.isfinite(h)
    if start is None:
        good[:1] = np.isfinite(h[:1])
    if not good.all():
        k = int(np.argmin(good))
        raise ConfigurationError(
            f'run: expected finite times that increase, got t[{k}] = {t[k]} after {before[k]}'
        )
    return np.asarray(h * 1e-9 if np.issubdtype(t.dtype, np.integer) else h)
