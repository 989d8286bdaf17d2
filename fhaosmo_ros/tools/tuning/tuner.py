# SPDX-License-Identifier: Apache-2.0
"""
The search for gains on simulated recordings: from recordings and parameters to the best gains.

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
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import Family, FAMILY_PARAMETERS, Recording
from fhaosmo_ros.tools.cli.command import progress
from fhaosmo_ros.tools.tuning.linear_gains import (
    chosen_otherwise,
    GAMMA,
    kalman_gains,
    rounded,
    SCHEME,
    WIDTH,
)
from fhaosmo_ros.tools.tuning.objective import Objective
from fhaosmo_ros.tools.tuning.search import Dimension, minimise, Values
import numpy as np

HELD_OUT_SEED = 1_000_003
"""Added to the seed: held-out recordings share no random number with the others."""
MODEL_OF_D = ('unknown_input_size', 'unknown_input_decay')
"""What is searched where gains follow from the model of d."""
DERIVATIVES, RATES = (0, 1, 2, 3), np.geomspace(0.1, 30.0, 8).tolist()
GRID: dict[str, Sequence[float]] = {
    'unknown_input_derivatives': DERIVATIVES,
    'unknown_input_decay': RATES,  # 1/s
}
DECADES = 3.0
"""Powers of ten around its start to which a search in logarithms goes."""
LOST_TIME, LOST_SAMPLES = 0.1, 20
"""
Seconds, and at least so many samples, for which the innovation exceeds the largest half-width
before the estimator restarts. With all levels saturated the chain of integrators may oscillate
without end.
"""


def simulated(values: Parameters, seed: int) -> tuple[list[Recording], list[Recording]]:
    """Return recordings of the family of `TUNE_PARAMETERS`: to train on, and to judge by."""
    family = Family(FAMILY_PARAMETERS.complete(values))
    return (
        family.recordings(values['recordings'], seed),
        family.recordings(values['held_out'], seed + HELD_OUT_SEED),
    )


class Tuner:
    """
    A search: where it begins, what is tried, and what comes of it.

    Parameters
    ----------
    training : list of Recording
    estimator : mapping
        What the user set for the estimator.
    tuning : mapping
        Of `TUNE_PARAMETERS`, complete.
    seed : int

    Raises
    ------
    ConfigurationError
        Parameters that do not fit together, or recordings that do not fit them.

    """

    def __init__(
        self,
        training: list[Recording],
        estimator: Mapping[str, Any],
        tuning: Mapping[str, Any],
        seed: int,
    ) -> None:
        self.tuning, self._seed = tuning, seed
        self._period = rounded(float(np.median(np.diff(training[0].t))))
        # The estimator may have a model of its own, other than the plant's.
        own = {name: tuning[name] for name in ('order', 'phi')} | dict(estimator)
        self._noise, self._fixed = 0.0, own
        self.objective = Objective(training, tuning)
        fuzzy = own.get('variant', SCHEME['variant']).startswith('fuzzy')
        kalman = fuzzy and not chosen_otherwise(own)
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
            'gamma_initial': min(max(GAMMA, own.get('gamma_min', 0.0)), own.get('gamma_max', 1.0)),
        }
        if noise <= least:
            # The largest innovations are those of the start: what z_2 moves y by in a period.
            width = max(sizes[1] * self._period, least)
        elif min(sizes) > 0.0:
            found |= {'noise_size': noise, 'state_sizes': sizes[:-1]}
        return found | {'fuzzy_widths': [WIDTH * width]}

    def parameters(self, values: Values) -> dict[str, Any]:
        """
        Return the parameters of the estimator at a point of the space.

        Raises
        ------
        ConfigurationError
            Values that are out of their bounds, or do not fit together.

        """
        changes = _changes(values)
        found = self._fixed | changes
        p = ESTIMATOR_PARAMETERS.complete(found)
        if self._noise and 'lambda' not in changes:
            power = p['gamma_initial'] if p['variant'].endswith('_adaptive') else FIXED_GAMMA
            noise = p['noise_size'] or self._noise
            design = p.changed({'noise_size': noise, 'gamma_initial': power})
            found['lambda'] = [*map(rounded, kalman_gains(design, self._period)[0])]
            if not p['noise_size']:  # nothing says how sure the observer is
                found.pop('unknown_input_size')
        if p['structure'] == 'levant' and p['variant'].startswith('fuzzy') and not p['noise_size']:
            lost = rounded(max(LOST_TIME, LOST_SAMPLES * self._period))
            found = {'epsilon': max(p['fuzzy_widths']), 'divergence_time': lost} | found
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
        problem = json.dumps([dict(self.tuning), self._fixed, self.space], sort_keys=True)
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
            low, high = start['gamma_min'], start['gamma_max']
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
