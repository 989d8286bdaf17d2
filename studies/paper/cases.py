# SPDX-License-Identifier: Apache-2.0
"""The paper's simulations and ours beside them: what is run, and how it is judged."""

from functools import lru_cache
from typing import Any, NamedTuple

from fhaosmo_ros.core import Observer, Plant
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS, PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import chatter, high_passed, rms, settling_time
from fhaosmo_ros.tools.cli.share import shipped
import numpy as np
from numpy.typing import NDArray
from studies.paper.plant_and_observer import JointRun, simulate

Floats = NDArray[np.float64]

FREQUENCIES = (1.0, 5.0)
"""Low (the paper's own) and high; the paper does not print its high one. rad/s."""
DURATION = 20.0
CONVERGED = 10.0
"""Errors and chatter are measured from here on, in seconds."""
GRID = 1e-3
"""Seconds between two recorded samples; an observer with a longer step records each of its own."""
HIGH_PASS = 0.05
"""Window of a moving average in seconds; the high-passed part is the signal minus that average."""
SETTLED = 0.02
"""Half-width of the settling band of d: a tenth of the range of d."""
Score = dict[str, float]
"""Scores of a run by name; see `score`."""


class Case(NamedTuple):
    """A variant, its step (s), and what differs from config/paper.yaml."""

    variant: str
    step: float
    changes: dict[str, Any]


OBSERVERS = {
    'sign, 1e-5 s': Case('sign', 1e-5, {}),
    'sign, 1e-3 s': Case('sign', 1e-3, {}),
    'fuzzy, 1e-3 s': Case('fuzzy', 1e-3, {}),
    'fuzzy adaptive, 1e-3 s': Case('fuzzy_adaptive', 1e-3, {}),
}
"""The four observers of the paper's section 3 and 4; below one of ours."""
SAFE = {
    p.name: p.default
    for p in OBSERVER_PARAMETERS.values()
    if p.name.startswith('gamma_') and p.name != 'gamma_initial'
}
"""The law of gamma with its default settings, where config/paper.yaml has the paper's."""
OBSERVERS |= {'fuzzy adaptive, default law, 1e-3 s': Case('fuzzy_adaptive', 1e-3, SAFE)}


class Preset(NamedTuple):
    """Parameters of config/paper.yaml, with defaults for the rest."""

    observer: Parameters
    plant: Parameters


@lru_cache
def preset() -> Preset:
    """Read the paper's numbers from the shipped configuration."""
    path = shipped('config/paper.yaml')
    return Preset(
        *(
            table.complete(load(path, node, table))
            for node, table in (('estimator', OBSERVER_PARAMETERS), ('plant', PLANT_PARAMETERS))
        )
    )


def simulated(name: str, omega: float, solver: str, **changes: Any) -> JointRun:
    """Simulate one of `OBSERVERS` as the paper does: plant and observer together."""
    variant, step, own = OBSERVERS[name]
    numbers = preset()
    return simulate(
        numbers.observer.changed({'variant': variant} | own | changes),
        numbers.plant.changed({'disturbance_omega': omega}),
        solver,
        step,
        DURATION,
        max(1, round(GRID / step)),
    )


class Truth(NamedTuple):
    """Samples of a plant."""

    t: Floats
    y: Floats
    z: Floats
    unknown_input: Floats


@lru_cache(maxsize=len(FREQUENCIES))
def truth_of(omega: float, step: float, noise: float, duration: float) -> Truth:
    """Simulate the plant alone; the last results are kept, because several observers use them."""
    plant = Plant(
        preset().plant.changed(
            {'disturbance_omega': omega, 'noise_std': noise, 'integration_step': min(step, 1e-3)}
        )
    )
    t = np.arange(round(duration / step) + 1) * step
    truth = plant.simulate(t)
    return Truth(t, truth.y, truth.z, truth.unknown_input)


def observe(truth: Truth, variant: str, scheme: str, every: int = 1, **changes: Any) -> JointRun:
    """Run an observer as a node does, one step a sample; record every `every`-th step."""
    observer = Observer(
        preset().observer.changed({'variant': variant, 'scheme': scheme} | changes)
    )
    run = observer.run(truth.t, truth.y, every=every)
    rows = slice(every - 1, None, every)
    z, d = truth.z[rows], truth.unknown_input[rows]
    return JointRun(run.t, z, d, run.z_hat, run.z_tilde, run.gamma)


def sampled(
    variant: str, omega: float, step: float, scheme: str, noise: float = 0.0, **changes: Any
) -> JointRun:
    """Simulate as a node runs: samples of a plant, one observer step a sample."""
    return observe(truth_of(omega, step, noise, DURATION), variant, scheme, **changes)


def first_observer(step: float, solver: str, duration: float, every: int) -> JointRun:
    """Simulate figure sim1: sign, n = 3, no model of Phi_3, theta estimates eta = -z3 + d."""
    numbers = preset()
    three = {k: numbers.observer[k][:3] for k in ('lambda', 'alpha')}
    observer = numbers.observer.changed(
        three
        | {
            'variant': 'sign',
            'unknown_input': False,
            'phi': ['0', '0', '0'],
            'initial_estimate': [0.05, 0.0, 0.05],
            'initial_internal': [0.05, 0.0, 0.05],
        }
    )
    return simulate(observer, numbers.plant, solver, step, duration, every)


def score(run: JointRun, start: float = CONVERGED) -> Score:
    """
    Judge the filtered estimates (the paper's 'estimated state') from `start` on.

    Returns
    -------
    dict
        rms_z1 .. rms_zn, rms_d: RMS errors. true_d: RMS of d. bias_d: mean error of d. settling:
        time from which the error of d stays within `SETTLED` (s). variation: total variation of
        the estimate of d over that of d. high_pass: RMS of its high-passed part. gamma: the last.

    """
    late = run.t >= start
    n = run.z.shape[1]
    d, estimate = run.unknown_input, run.z_hat[:, n]
    errors = run.z_hat[late, :n] - run.z[late]
    result = {f'rms_z{i + 1}': rms(errors[:, i]) for i in range(n)}
    return result | {
        'rms_d': rms((estimate - d)[late]),
        'true_d': rms(d[late]),
        'bias_d': float(np.mean((estimate - d)[late])),
        'settling': settling_time(run.t, estimate - d, SETTLED),
        'variation': chatter(estimate[late], d[late]),
        'high_pass': high_passed(estimate[late], max(1, round(HIGH_PASS / run.t[1]))),
        'gamma': float(run.gamma[-1]),
    }
