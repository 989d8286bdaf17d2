# SPDX-License-Identifier: Apache-2.0
"""The update path of time-stamped samples, shared by the node and by replays of bags."""

from collections.abc import Mapping
from copy import deepcopy
import math
import operator
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.model.inputs import known_inputs, samples_of_run
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory, Tuning
from fhaosmo_ros.core.observer.numbers import checked
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.observer.smoother import Smoother
from fhaosmo_ros.core.observer.smoothing import Passes
from fhaosmo_ros.core.online.events import EventDetector, Progress
from fhaosmo_ros.core.online.policy import Counters, Policy
from fhaosmo_ros.core.online.snapshots import VERSION
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import make_from_file
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS
import numpy as np
from numpy.typing import ArrayLike, NDArray

NANOSECONDS = 1e-9
SILENCE, SILENT_SAMPLES = 0.5, 5
"""Seconds, and usual intervals, after which y is said to be silent; the larger of both."""
LARGEST_STAMP = 2**63 - 1


class OnlineEstimator:
    """
    An observer fed with time-stamped samples.

    Bad data does not raise and never makes an estimate that is not finite: it is rejected or
    survived, counted, and told by the status word; docs/node.md says how, case by case. A second
    thread that uses one while it runs gets a RuntimeError.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the observer's and the sampling parameters in docs/parameters.md; defaults for
        the rest. `Parameters` have been checked and are taken as they are.
    **named
        Parameters as keyword arguments, which win; ``lambda_`` for ``lambda``.

    Attributes
    ----------
    observer : Observer
        To read parameters, sizes and state from; samples go through this class.
    events : EventDetector
        Judges each estimate of d, as it is before any smoothing; `events.taken()` returns what has
        begun or ended since it was called last.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None, /, **named: Any) -> None:
        given = ESTIMATOR_PARAMETERS.complete(parameters, named)
        p = self._parameters = ONLINE_PARAMETERS.complete(given)
        self.observer, lag = Observer(p), round(p['smoothing_lag'] / NANOSECONDS)
        _check(p, smooths=lag > 0)
        self.smoothing = Smoother(self.observer, lag) if lag else None
        self.policy = Policy(self.observer.structure, p)
        self.events = EventDetector(p)

    def __copy__(self) -> 'OnlineEstimator':
        return deepcopy(self)

    def __repr__(self) -> str:
        return f'OnlineEstimator({self.observer!r}, {self.counters!r})'

    @classmethod
    def from_yaml(
        cls, path: str | Path, node: str = 'estimator', channel: str = ''
    ) -> 'OnlineEstimator':
        """Return one with the parameters of a file for ROS; see `Observer.from_yaml`."""
        return make_from_file(cls, path, node, channel)

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters with their present values; a copy."""
        return dict(self._parameters)

    @property
    def counters(self) -> Counters:
        """What has happened to the samples so far."""
        return Counters(**self.policy.counters)

    @property
    def stamp(self) -> int | None:
        """
        Time of the latest estimate in nanoseconds; None where `estimate` is None.

        The stamp of its sample, less `measurement_delay` unless the estimate is carried over it.
        With `smoothing_lag` its sample is the one that is so old.
        """
        if self.smoothing is not None:
            return self.smoothing.stamp if self.smoothing.estimate else None
        return self.policy.stamp  # type: ignore[no-any-return]

    @property
    def period(self) -> float:
        """Running mean of the intervals between samples, in seconds; 0 before there are any."""
        return float(self.policy.course['mean_interval'] * NANOSECONDS)

    @property
    def offset(self) -> float:
        """What y is taken to be too large by, since a jump that the model contradicts (D 23)."""
        return float(self.observer.structure.memory['offset'])

    def prepare(self, changes: Mapping[str, Any]) -> tuple[Parameters, ObserverConfiguration]:
        """Return what follows from these changes; raise as `configure`, change nothing."""
        parameters = self._parameters.changed_live(changes, 'observer')
        configuration = ObserverConfiguration(parameters)
        _check(parameters, smooths=self.smoothing is not None)
        if self.smoothing is not None:
            Passes(configuration)
        return parameters, configuration

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change live parameters from the next sample on, without a jump; all or nothing.

        Raises
        ------
        ConfigurationError
            An unknown name, a bad value, or a parameter that can't change live.

        """
        parameters, configuration = self.prepare(changes)
        with self.policy:
            self.observer.adopt(configuration)
            self.events.configure(parameters)
            if self.smoothing is not None:
                self.smoothing.configure()
            self._parameters = parameters
            self.policy.adopt(self.observer.structure, parameters)

    @property
    def silence(self) -> float:
        """Time without a sample, in seconds, after which nothing is known of the present."""
        return float(self._parameters['max_gap'] or max(SILENCE, SILENT_SAMPLES * self.period))

    def reset(self) -> None:
        """Start afresh: the next sample is the first. Counters go on."""
        with self.policy:
            self.policy.reset()
            self.events.reset()
            if self.smoothing is not None:
                self.smoothing.cut()

    def smooth(self) -> None:
        """
        Let `run` return estimates by all samples, each once later ones do not matter to it.

        `finish` returns the rest. To be called before the first sample; a `smoothing_lag` is
        forgotten. Memory stays bounded.

        Raises
        ------
        ConfigurationError
            `noise_size` is 0, which says how much to trust a sample; or `predict_to_now`.

        """
        _check(self._parameters, smooths=True)
        self.smoothing = Smoother(self.observer)

    def finish(self) -> Trajectory:
        """Return the smoothed estimates that still wait: nothing comes after them."""
        if self.smoothing is None:
            raise ConfigurationError('finish: expected smoothing_lag > 0, or a call of `smooth`')
        with self.policy:
            return self.smoothing.finish()

    @property
    def latest(self) -> int | None:
        """Stamp of the latest sample that was used, in nanoseconds; a reset does not forget it."""
        return self.policy.course['stamp'] or None

    def state_dict(self) -> dict[str, Any]:
        """Return all that it remembers, by name, but for counters and parameters; a copy."""
        return {
            'version': VERSION, **self.observer.structure.state_dict(), **vars(self.events.memory),
            **self.policy.memory,
        }  # fmt: skip

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """
        Go on where an estimator with the same model and delays was; parameters and counters stay.

        Parameters
        ----------
        values : mapping
            As `state_dict` returns them.

        Raises
        ------
        ConfigurationError
            Something is missing, of another size, or out of its range. Then nothing has changed.

        """
        version = checked(values, {'version': VERSION})['version']
        if version != VERSION:
            raise ConfigurationError(f'snapshot: expected version {VERSION}, got {version}')
        own, events = self.policy.memory, vars(self.events.memory)
        pieces = values.get('past_pieces', np.zeros(0))
        if isinstance(pieces, np.ndarray) and pieces.size != own['past_pieces'].size:
            raise ConfigurationError(
                'snapshot: expected that of an estimator with the same measurement_delay'
            )
        own, events = checked(values, own), checked(values, events)
        with self.policy:
            self.observer.structure.load_state_dict(values)
            self.policy.change(**own)
            self.events.memory = Progress(**events)
            if self.smoothing is not None:
                self.smoothing.cut()

    @property
    def inputs(self) -> tuple[float, ...]:
        """The known inputs that are held, in the order of `Observer.inputs`."""
        return tuple(self.policy.arrays['u'].tolist())

    def set_input(self, u: float, index: int = 0) -> None:
        """
        Hold a known input from now on.

        Parameters
        ----------
        u : float
            If it is not finite, the one before is held, and this one counted.
        index : int
            Which one, in the order of `Observer.inputs`.

        """
        if math.isfinite(u):
            self.policy.arrays['u'][index] = u
        else:
            rejected = self.policy.counters['rejected_inputs'] + 1
            self.policy.counters |= {'rejected_inputs': rejected}

    def update(self, stamp: int, y: float) -> Estimate | None:
        """
        Take one sample.

        Parameters
        ----------
        stamp : int
            Time of the sample in nanoseconds, of any clock.
        y : float
            Measured output; NaN and infinity are rejected and counted.

        Returns
        -------
        Estimate
            Of this sample, or the previous state's with the reason of the rejection. With
            `smoothing_lag` that of the time so long ago; None while there is none.

        Raises
        ------
        TypeError
            A stamp that is no integer: seconds are not nanoseconds.

        """
        self.advance(min(max(operator.index(stamp), -LARGEST_STAMP), LARGEST_STAMP), y)
        return self.policy.report() if self.smoothing is None else self.estimate

    def advance(self, stamp: int, y: float) -> int:
        """Do what `update` does, of a stamp of 64 bits, and return only the status word."""
        if self.smoothing is None and not self.events.on:
            return self.policy.advance(stamp, y)  # type: ignore[no-any-return]
        self._run(np.array([stamp]), np.array([float(y)]), self.policy.arrays['u'][np.newaxis])
        return self.observer.structure.word  # type: ignore[no-any-return]

    def run(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike | None = None) -> Trajectory:
        """
        Take many samples, bit for bit as `update` would take one after the other.

        Parameters
        ----------
        stamps : (K,) array of int
            Times of the samples in nanoseconds.
        y : (K,) array
            Samples.
        u : number, (K,) or (K, m) array, optional
            Known input, or known inputs, of the interval that ends at each sample; without it,
            those that are held.

        Returns
        -------
        Trajectory
            A row for every sample, whose status says whether it was rejected. ``t`` holds the
            times of the estimates, as `stamp`. With `smoothing_lag`, or after `smooth`, a row for
            each used sample whose estimate has become final.

        Raises
        ------
        ConfigurationError
            Arrays whose shapes do not fit, or stamps that are no integers.

        """
        stamps, y = samples_of_run(stamps, y)
        if len(stamps) and stamps.dtype != np.int64:
            raise ConfigurationError(
                f'run: expected stamps in nanoseconds, which are integers, got {stamps.dtype}'
            )
        u = np.tile(self.policy.arrays['u'], (len(y), 1)) if u is None else u
        inputs = known_inputs(u, self.observer.inputs, len(y))
        return self._run(stamps.astype(np.int64, copy=False), y, inputs)

    def _run(self, stamps: NDArray[Any], y: NDArray[Any], u: NDArray[Any]) -> Trajectory:
        """Take samples with their known inputs, and look at them for events and for smoothing."""
        with self.policy:
            record, placed, present, times, acting = self.policy.run(stamps, y, u)
            found = Trajectory(placed - self.policy.behind, **record.columns)
            if self.events.on:
                deviations = found.standard_deviation[:, -1] if self.observer.self_tuning else None
                self.events.take(found.t, found.unknown_input, deviations, times, found.status)
            if len(present):
                found = found._replace(z=present[:, :-1], unknown_input=present[:, -1])
            if self.smoothing is not None:
                return self.smoothing.take(found, times, acting)
            return found

    @property
    def estimate(self) -> Estimate | None:
        """
        The latest estimate.

        None before the first sample (that is `smoothing_lag` old), and from a jump of y, which z_1
        follows at once, until the next sample that is used.
        """
        if self.smoothing is not None:
            return self.smoothing.estimate
        return None if self.policy.stamp is None else self.policy.report()

    @property
    def standard_deviation(self) -> NDArray[np.float64]:
        """Those of the errors of `estimate`: z and d, (n + 1,); NaN with fixed gains."""
        return (self.smoothing or self.observer).standard_deviation

    @property
    def tuning(self) -> Tuning:
        """What a self-tuning observer had found at the sample of `estimate`."""
        if self.smoothing is not None:
            return Tuning.of(self.smoothing.tuning)
        return self.observer.tuning


def _check(p: Mapping[str, Any], smooths: bool) -> None:
    """Raise ConfigurationError where values do not fit together, also for who `smooths`."""
    if p['input_delay'] > p['measurement_delay']:
        raise ConfigurationError(
            "parameters 'input_delay', 'measurement_delay': expected each at most the next one, "
            f'got {p["input_delay"]} and {p["measurement_delay"]}'
        )
    if p['event_deviations'] and p['gains'] != 'self_tuning':
        raise ConfigurationError(
            "parameters 'event_deviations', 'gains': expected gains = 'self_tuning', which knows "
            'the standard deviation of d, or event_deviations = 0 (event_threshold needs no '
            f'standard deviation), got {p["event_deviations"]:g} and {p["gains"]!r}'
        )
    if smooths and p['predict_to_now']:
        raise ConfigurationError(
            "smoothing, 'predict_to_now': expected estimates of the past or of the present, "
            'got both'
        )
