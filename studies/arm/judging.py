# SPDX-License-Identifier: Apache-2.0
"""How observers of external torques are tuned and judged."""

from typing import Any

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.arm.identification import identify
from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.tools.tuning.search import minimise
import numpy as np
from studies.arm.peers import momentum, PEERS
from studies.arm.world import Errors, Floats, PERFECT, simulate, Touched, UNSEEN, urdf_of
from studies.evidence import Row

OURS, CALIBRATED = 'all joints together', 'the same, calibrated'
SETTLED = 0.5
"""Seconds from when errors count."""
LATEST = 0.5
"""Seconds after which a contact counts as not found."""
TRAINED, JUDGED, FREE = 1, (21, 22), 29
"""Seeds; ours was tuned once, on 1 and 4 of all three arms."""
TRIALS = {1: 40, 2: 60, 4: 120}
"""Evaluations by the number of parameters of a peer."""
SITUATIONS: dict[str, dict[str, Any]] = {
    'pushes': {},
    'other kinds': {'kinds': UNSEEN},
    'wall': {'wall': True},
    '10 % payload': {'errors': Errors(payload=0.1)},
}


def judged(robot: str, by_position: bool, duration: float, quick: bool) -> list[Row]:
    """Return a row for each observer of one arm; peers are tuned on other contacts."""
    urdf = urdf_of(robot)
    model = ArmModel(urdf)

    def run(seed: int, seconds: float = duration, errors: Errors = PERFECT, **options: Any):
        return simulate(
            urdf, model.joints, model.links, seconds, seed, errors=errors, weight=model.weight,
            **options,
        )  # fmt: skip

    recordings = {
        name: [run(seed, **options) for seed in JUDGED] for name, options in SITUATIONS.items()
    }
    trained, free = run(TRAINED), run(FREE, 3.0 * duration, kinds=())
    everything = [free, *(w for group in recordings.values() for w in group)]
    prepared = {id(w): momentum(model, w, by_position) for w in [trained, *everything]}
    rows: list[Row] = []
    for name, (peer, space) in PEERS.items():

        def error(values, peer=peer):
            with np.errstate(all='ignore'):
                return rmse(trained, peer(prepared[id(trained)], values))

        best = minimise(error, space, 5 if quick else TRIALS[len(space)]).best
        found = {id(w): peer(prepared[id(w)], best) for w in everything}
        late = free.t > SETTLED
        size = np.sqrt(np.mean(found[id(free)][late] ** 2, axis=0))
        alarms = {key: np.max(np.abs(e) / size, axis=1) for key, e in found.items()}
        rows.append({'observer': name, **_row(recordings, free, found, alarms), **best})
    loaded = run(FREE, 3.0 * duration, kinds=(), **SITUATIONS['10 % payload'])
    known = {
        id(w): identify(model, motion.t, motion.q, motion.torque).calibration
        for group, motion in (((free,), free), (recordings['10 % payload'], loaded))
        for w in group
    }
    for name in (OURS, CALIBRATED):
        found, alarms, within = {}, {}, []
        for w in everything:
            calibration = known.get(id(w), known[id(free)]) if name == CALIBRATED else None
            arm = Arm(
                urdf, calibration=calibration,
                measurement='position' if by_position else 'velocity',
            )  # fmt: skip
            estimates = arm.run(w.t, w.q, w.torque, w.velocity)
            found[id(w)], alarms[id(w)] = estimates.external_torque, estimates.log_odds
            if any(w is pushed for pushed in recordings['pushes']):
                error_ = np.abs(estimates.external_torque - w.truth)
                within.append((error_ / estimates.standard_deviation)[w.t > SETTLED])
        both = np.concatenate(within)
        rows.append({
            'observer': name, **_row(recordings, free, found, alarms),
            'within 1': float(np.mean(both < 1.0)), 'within 1.96': float(np.mean(both < 1.96)),
        })  # fmt: skip
    columns = dict.fromkeys(key for r in reversed(rows) for key in r)
    return [{column: r.get(column) for column in columns} for r in rows]


def rmse(w: Touched, estimate: Floats) -> float:
    """Return the root mean square error, summed over joints."""
    late = w.t > SETTLED
    return float(np.sum(np.sqrt(np.mean((estimate[late] - w.truth[late]) ** 2, axis=0))))


def _row(recordings, free, found, alarms) -> Row:
    """Return errors by situation, and delays at one false alarm in the free motion."""
    row: Row = {
        name: float(np.mean([rmse(w, found[id(w)]) for w in group]))
        for name, group in recordings.items()
    }
    threshold = np.nanmax(alarms[id(free)][free.t > SETTLED])
    pushed = [*recordings['pushes'], *recordings['other kinds']]
    delays, beyond = [], []
    for w in pushed:
        for k, kind, length in zip(w.begins, w.kinds, w.lasts, strict=True):
            over = np.flatnonzero(alarms[id(w)][k : k + int(LATEST * 1e3)] > threshold)
            delays.append(over[0] if len(over) else LATEST * 1e3)
            if kind == 'step':
                beyond.append(overshoot(w.truth[k : k + length], found[id(w)][k : k + length]))
    row['delay'], row['delay p90'] = (float(np.quantile(delays, s)) for s in (0.5, 0.9))
    row['overshoot'] = float(np.median(beyond)) if beyond else np.nan
    return row


def overshoot(truth: Floats, estimate: Floats) -> float:
    """Return by how much the estimate of a step, along the truth, was beyond it at most."""
    size = np.sum(truth**2, axis=1)
    return float(np.max(np.sum(truth * estimate, axis=1) / size)) - 1.0
