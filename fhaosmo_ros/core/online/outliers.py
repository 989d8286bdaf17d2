# SPDX-License-Identifier: Apache-2.0
"""The policy's rules for values (see policy.py), each a small compiled function."""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.observer.arrays import HAT, TILDE
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy
from fhaosmo_ros.core.online.stamps import difference


@compiled()
def is_stuck(policy: Policy, last: float, y: float, now: int) -> bool:
    """Return True, and count it, if y has been seen unchanged for longer than stuck_time."""
    ints = policy.ints
    silence = abs(difference(now, ints[at.SEEN]))
    ints[at.SEEN] = now
    if y != last or silence > ints[at.MAX_GAP]:
        ints[at.CHANGED] = now
        ints[at.STUCK] = 0
        return False
    if difference(now, ints[at.CHANGED]) <= ints[at.STUCK_TIME]:
        return False
    if not ints[at.STUCK]:
        ints[at.STUCK] = 1
        ints[at.STUCK_EVENTS] += 1
    ints[at.REJECTED_STUCK_] += 1
    return True


@compiled()
def is_spike(policy: Policy, innovation: float) -> bool:
    """Return True, and count it, if y is too far from its prediction to be believed yet."""
    ints, reals = policy.ints, policy.reals
    if abs(innovation) <= reals[at.GATE]:
        ints[at.SPIKES] = 0
        return False
    ints[at.SPIKES] += 1
    if ints[at.SPIKES] > ints[at.GATE_SAMPLES]:
        ints[at.SPIKES] = 0
        ints[at.SPIKES_BELIEVED] += 1
        return False
    ints[at.REJECTED_SPIKES] += 1
    return True


@compiled(forceinline=True)
def has_diverged(e: EstimatorArrays, innovation: float, failed: bool, now: int) -> bool:
    """Return True if the state is beyond divergence_limit, or y is lost for divergence_time."""
    levels, ints, reals = e.state.levels, e.policy.ints, e.policy.reals
    for i in range(levels.shape[1]):
        if not max(abs(levels[HAT, i]), abs(levels[TILDE, i])) <= reals[at.LIMIT]:
            return True
    if not failed and abs(innovation) <= reals[at.EPSILON]:
        ints[at.LOST] = 0
        return False
    if not ints[at.LOST]:
        ints[at.LOST] = 1
        ints[at.LOST_SINCE] = now
        return False
    if ints[at.DIVERGENCE_TIME] == 0:
        return False
    return bool(difference(now, ints[at.LOST_SINCE]) > ints[at.DIVERGENCE_TIME])
