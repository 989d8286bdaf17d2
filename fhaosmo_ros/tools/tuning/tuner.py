# SPDX-License-Identifier: Apache-2.0
"""
The search for gains on simulated recordings, and what a set of gains is worth there.

Where the user sets no other structure or scheme, and no lambda, the start is a Kalman filter for
a model of d (D 19): how many derivatives of d to follow, and how fast d changes, are tried on a
small grid. Then Optuna searches size and rate of d, and lambda follows. Else it searches the gains
themselves, from the user's, or the default ones.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
import hashlib
from itertools import product
import json
import math
from typing import Any

from fhaosmo_ros.core.observer.configuration import FIXED_GAMMA, of_level
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters, ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import (
    ESTIMATOR_PARAMETERS,
    OBSERVER_PARAMETERS,
    ONLINE_PARAMETERS,
)
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import (
    Family,
    FAMILY_PARAMETERS,
    fixed,
    Recording,
)
from fhaosmo_ros.tools.cli.command import progress
from fhaosmo_ros.tools.tuning.linear_gains import (
    chosen_otherwise,
    GAMMA,
    kalman_gains,
    rounded,
    SCHEME,
    WIDTH,
)
from fhaosmo_ros.tools.tuning.search import Dimension, minimise, Values
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
TUNING = (
    fixed('recordings', 36, 'Number of recordings that the search sees.', lower=1, upper=10_000),
    fixed('held_out', 36,
          'Number of other recordings, with other seeds, that only the report sees.', lower=1,
          upper=10_000),
    fixed('settled', 5.0, 'Errors count from this time of a recording on.', unit='s', lower=0.0,
          upper=1e5),
    fixed('weights', [1.0],
          'Weight of the error of each estimate, squared and relative to the RMS of its truth.',
          lower=0.0, upper=1e9, lengths='1 (d alone) or n + 1 (z1 .. zn, d)'),
)  # fmt: skip
TUNE_PARAMETERS = ParameterTable(FAMILY_PARAMETERS.declared, TUNING)
"""All that `tune` takes beside the estimator's parameters."""
FIRST_STAMP = 1_000_000_000  # ns, of a recording's first sample; 0 is that of a stamp not set
SMALLEST = 1e-12  # smaller relative errors count as this one: their logarithm is finite
HELD_OUT_SEED = 1_000_003
"""Added to the seed: held-out recordings share no random number with the others."""
MODEL_OF_D = ('unknown_input_size', 'unknown_input_decay')
"""What is searched where gains follow from the model of d."""
DERIVATIVES, RATES = (0, 1, 2, 3), np.geomspace(0.1, 30.0, 8).tolist()
GRID: dict[str, Sequence[float]] = {
    'unknown_input_derivatives': DERIVATIVES,
    'unknown_input_decay': RATES,  # 1/s
}
GAINS = 'lambda', 'alpha', 'epsilon', 'initial_internal'
"""Gains that the user sets are where a search of the gains themselves begins."""
DECADES = 3.0  # powers of ten around its start to which a search in logarithms goes


def simulated(values: Parameters, seed: int) -> tuple[list[Recording], list[Recording]]:
    """Return recordings of the family of `TUNE_PARAMETERS`: to train on, and to judge by."""
    family = Family(FAMILY_PARAMETERS.complete(values))
    return (
        family.recordings(values['recordings'], seed),
        family.recordings(values['held_out'], seed + HELD_OUT_SEED),
    )


def stamps_of(t: Floats) -> NDArray[np.int64]:
    """Return stamps (ns) for times since the first sample (s)."""
    return FIRST_STAMP + np.round(t * 1e9).astype(np.int64)


class Objective:
    """
    Evaluates parameters of the estimator on recordings to train on, by the node's code.

    `tuning` has values of `TUNING`. Errors are divided by `scale`, (n + 1,): the RMS values of the
    recordings' z and d. Raises ConfigurationError for a recording that is too short, or weights
    that do not fit.
    """

    def __init__(self, recordings: Sequence[Recording], tuning: Mapping[str, Any]) -> None:
        self.recordings, self._settled = recordings, tuning['settled']
        shortest = min(r.t[-1] - r.t[0] for r in recordings)
        if shortest <= self._settled:
            raise ConfigurationError(
                f'recording: expected more than {self._settled:g} s (settled), got {shortest:g} s'
            )
        late = [np.column_stack([r.z, r.d])[r.t - r.t[0] >= self._settled] for r in recordings]
        self.scale = rms(np.concatenate(late))
        weights, count = tuning['weights'], len(self.scale)
        if len(weights) not in (1, count) or not sum(weights) > 0.0:
            raise TUNE_PARAMETERS['weights'].error(
                weights, f'1 or {count} numbers, not all of them 0'
            )
        self._weights = np.zeros(count)
        self._weights[-len(weights) :] = np.array(weights) / sum(weights)

    def __call__(
        self, parameters: Mapping[str, Any], held_out: Sequence[Recording] = ()
    ) -> tuple[float, Floats]:
        """
        Return what parameters are worth, and RMS errors of z_1 .. z_n and d, a row a recording.

        The first is the weighted RMS error relative to the RMS of the truth. It is the geometric
        mean over the recordings, so that an error smaller by a tenth counts the same on an easy
        recording and on a hard one. Raises ConfigurationError as `OnlineEstimator`, and for
        another model than that of the recordings.
        """
        estimator = OnlineEstimator(ONLINE_PARAMETERS.part_of(parameters))
        order, states = estimator.observer.order, len(self.scale) - 1
        if order != states:
            raise ConfigurationError(
                f"'order': expected {states}, the states of the plant's recordings, got {order}"
            )
        errors = np.array([self._judge(estimator, r) for r in held_out or self.recordings])
        used = self._weights > 0.0
        with np.errstate(over='ignore', divide='ignore'):  # of a truth that is 0 throughout
            relative = np.square(errors[:, used] / self.scale[used])
        each = np.sqrt(relative @ self._weights[used])
        return float(np.exp(np.mean(np.log(np.maximum(each, SMALLEST))))), errors

    def _judge(self, estimator: OnlineEstimator, r: Recording) -> Floats:
        """Return the errors of z and d."""
        estimator.reset()
        u = r.u if estimator.observer.used_inputs else None
        found = estimator.run(stamps_of(r.t - r.t[0]), r.y, u)
        t = r.t[0] + (found.t - FIRST_STAMP) * 1e-9  # before the sample's, if that is delayed
        late = t - r.t[0] >= self._settled
        truth = np.column_stack([np.interp(t[late], r.t, x) for x in (*r.z.T, r.d)])
        with np.errstate(over='ignore', invalid='ignore'):
            errors = rms(np.column_stack([found.z, found.unknown_input])[late] - truth)
        # An estimate that is not finite is infinitely wrong, not undefined.
        return np.nan_to_num(errors, nan=np.inf)


class Tuner:
    """
    A search: where it begins, what is tried, and what comes of it.

    `estimator` has what the user set for the estimator, `tuning` all of `TUNE_PARAMETERS`. Raises
    ConfigurationError for parameters that do not fit together, or not to the recordings.
    """

    def __init__(
        self,
        training: list[Recording],
        estimator: Mapping[str, Any],
        tuning: Mapping[str, Any],
        seed: int,
    ) -> None:
        self.objective = Objective(training, tuning)
        self._tuning, self._seed = tuning, seed
        self._period = rounded(float(np.median(np.diff(training[0].t))))
        # The estimator may have a model of its own, other than the plant's.
        own = {name: tuning[name] for name in ('order', 'phi')} | dict(estimator)
        self._noise, self._fixed = 0.0, own
        fuzzy = own.get('variant', SCHEME['variant']).startswith('fuzzy')
        kalman = fuzzy and not chosen_otherwise(own) and own.keys().isdisjoint(GAINS)
        if kalman:
            self._fixed = self._kalman_start(own) | own
            free = {name: [own[name]] if name in own else grid for name, grid in GRID.items()}
            points = (dict(zip(free, point, strict=True)) for point in product(*free.values()))
            self._fixed |= _changes(min(points, key=self.evaluate)) | own
        start = self.parameters({})
        self.objective(start)  # raises what `evaluate` takes for a bad point
        observer = Observer(ESTIMATOR_PARAMETERS.complete(start))
        model = [name for name in MODEL_OF_D if name not in own]
        searched = model if kalman else _gains(observer.parameters)
        self.space = [d for name in searched for d in _dimensions(name, observer)]
        if not self.space:
            raise ConfigurationError(
                f'expected one of {", ".join(MODEL_OF_D)} to search, got both set'
            )

    def _kalman_start(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """Set the size of the noise, and return what the recordings say of the estimator."""
        recordings = self.objective.recordings
        sizes = [*map(rounded, rms(np.concatenate([np.c_[r.z, r.d] for r in recordings])))]
        # With quantum and jitter. Without noise the fastest observer is deadbeat: the least noise
        # is too small to slow it down.
        noise = rounded(rms(np.concatenate([r.y - r.z[:, 0] for r in recordings])))
        least = 0.1 * sizes[-1] * self._period ** (len(sizes) - 1)
        self._noise, width = max(noise, least), noise
        found = {
            **SCHEME,
            'correction_period': self._period,
            'unknown_input_size': sizes[-1],
            'gamma_initial': max(GAMMA, own.get('gamma_min', 0.0)),
        }
        if noise <= least:
            # The largest innovations are those of the start: what z_2 moves y by in a period.
            width = max(sizes[1] * self._period, least)
        elif min(sizes) > 0.0:
            found |= {'noise_size': noise, 'state_sizes': sizes[:-1]}
        return found | {'fuzzy_widths': [rounded(WIDTH * width)]}

    def parameters(self, values: Values) -> dict[str, Any]:
        """
        Return the parameters of the estimator at a point of the space.

        Raises ConfigurationError for values that are out of bounds, or do not fit together.
        """
        found = self._fixed | _changes(values)
        p = ESTIMATOR_PARAMETERS.complete(found)
        if self._noise:
            power = p['gamma_initial'] if p['variant'].endswith('_adaptive') else FIXED_GAMMA
            noise = p['noise_size'] or self._noise
            design = p.changed({'noise_size': noise, 'gamma_initial': power})
            found['lambda'], _ = kalman_gains(design, self._period)
            if not p['noise_size']:  # nothing says how sure the observer is
                found.pop('unknown_input_size')
        if p['structure'] == 'levant' and p['variant'].startswith('fuzzy') and not p['noise_size']:
            found = {'epsilon': max(p['fuzzy_widths'])} | found  # for `divergence_time`
        # The gains fit these only, so a file has them even where they are the defaults.
        return found | {name: p[name] for name in ('variant', 'scheme', 'unknown_input')}

    def evaluate(self, values: Values) -> float:
        """Return the objective at a point of the space."""
        try:
            return self.objective(self.parameters(values))[0]
        except ConfigurationError:  # values out of their bounds, or that do not fit
            return math.inf

    def search(
        self,
        trials: int,
        jobs: int = 1,
        storage: str | None = None,
        stopped: Callable[[], bool] = lambda: False,
    ) -> Any:
        """Search as `minimise` does, or until `stopped` returns True after a trial."""
        samples = [recording.y.tobytes() for recording in self.objective.recordings]
        problem = json.dumps([dict(self._tuning), self._fixed, self.space], sort_keys=True)
        digest = hashlib.sha256(b''.join([problem.encode(), *samples])).hexdigest()[:16]
        with progress(total=trials, unit='trial', desc='tune', smoothing=0.05) as bar:
            return minimise(
                self.evaluate, self.space, trials, self._seed, storage=storage,
                name=f'tune-{digest}', jobs=jobs, on_trial=lambda: bar.update() or stopped(),
            )  # fmt: skip


def _dimensions(name: str, observer: Observer) -> Iterator[Dimension]:
    """Yield those of a parameter: in powers of ten, where its scale is open."""
    declared, start = OBSERVER_PARAMETERS[name], observer.parameters
    values = {name: start[name]}
    if isinstance(start[name], list):
        levels = range(observer.levels)
        values = {f'{name}[{k}]': of_level(start[name], k) for k in levels}
    for label, value in values.items():
        middle = value or 1.0  # such as unknown_input_decay, which may be 0
        low = max(middle / 10.0**DECADES, declared.lower or 0.0)
        high = min(middle * 10.0**DECADES, declared.upper or 1.0)
        if name == 'gamma_initial':
            low, high = start['gamma_min'], 1.0
        log = 0.0 < 10.0 * low < high
        begin = min(max(middle if log else value, low), high)
        yield Dimension(label, low, high, begin, log)


def _changes(values: Values) -> dict[str, Any]:
    """Return the parameters of the observer at a point of the space, whose dimensions name it."""
    found: dict[str, Any] = {}
    for label, value in values.items():
        name, level, _ = label.partition('[')
        if level:
            found.setdefault(name, []).append(rounded(value))
        else:
            found[name] = value if isinstance(value, int) else rounded(value)
    return found


def _gains(start: Mapping[str, Any]) -> list[str]:
    """Return the gains that the structure and the variant use."""
    names = ['lambda', 'unknown_input_decay']
    if start['structure'] == 'cascade':
        names += ['alpha', 'epsilon']
    if start['variant'].startswith('fuzzy'):
        names.append('fuzzy_widths')
    if start['variant'].endswith('_adaptive'):
        names.append('gamma_initial')
    return names
