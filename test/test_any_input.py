# SPDX-License-Identifier: Apache-2.0
"""Whatever samples, stamps and parameters come: nothing raises, all that is shown is finite."""

from fhaosmo_ros.core import ConfigurationError
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameter
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from observer_cases import SMALL
import pytest

START = 1_700_000_000 * 10**9
WILD = [0.0, -0.0, 1e-320, 1e11, -1e12, 1e150, 1e308, -1e308, float('nan'), float('inf')]
JUMPS = [0, 1, -1, 1000, 10**6, -(10**6), 10**7, 3 * 10**8, 6 * 10**8, -(10**9), 3600 * 10**9]
NEVER = [None, {}, float('nan'), float('inf'), -1e300, 10**400, b'1', [[1.0]], [0.1, None]]
"""No parameter allows any of these."""
ABSOLUTE = [0, 1, -1, START, 2**63 - 1, -(2**63), 2**63, -(10**30), 10**30]


def valid(parameter: Parameter, rng: np.random.Generator):
    """Return a random value that the parameter alone allows."""
    if parameter.choices:
        return str(rng.choice(parameter.choices))
    if parameter.kind == 'bool':
        return bool(rng.integers(2))
    if parameter.kind == 'string_array':  # fuzzy_systems
        systems = ['terms 3', 'terms gaussian 5', 'terms trapezoid 7', 'curve 0 0 0.8', 'terms 4']
        return rng.choice(systems, rng.integers(1, 4)).tolist()
    low, high = parameter.lower, parameter.upper
    if parameter.kind == 'int':
        return int(rng.choice([low, high, rng.integers(low, min(high, low + 20), endpoint=True)]))
    scale = 10.0 ** rng.uniform(-6, np.log10(high))
    value = float(np.clip(scale * (rng.choice([-1, 1]) if low < 0 else 1), low, high))
    value = [value, high, value if parameter.lower_open else low][rng.choice(3, p=[0.8, 0.1, 0.1])]
    if parameter.kind == 'double_array':
        return [value] * int(rng.choice([1, 1, 3, 4]))
    return value


LIVE = [name for name, p in ONLINE_PARAMETERS.items() if p.live]


def changes(rng: np.random.Generator, bad: float) -> dict:
    """Return values for some parameters, each with probability `bad` not allowed."""
    found = {}
    for name in rng.choice(LIVE, size=rng.integers(1, 7), replace=False).tolist():
        is_bad = rng.random() < bad
        value = NEVER[rng.integers(len(NEVER))] if is_bad else valid(ONLINE_PARAMETERS[name], rng)
        found[name] = value
    return found


ahead = st.tuples(st.just('ahead'), st.sampled_from(JUMPS) | st.just(10**6))
stamps = ahead | st.tuples(st.just('at'), st.sampled_from(ABSOLUTE))
samples = st.one_of(st.sampled_from(WILD), st.floats(), st.floats(-1.0, 1.0))
event = st.one_of(
    *[st.tuples(st.just('y'), stamps, samples)] * 2,
    st.tuples(st.just('set'), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.0, 0.3])),
    st.tuples(st.just('u'), samples, st.none()),
    st.tuples(st.just('do'), st.sampled_from(['reset', 'forget']), st.none()),
)


@settings(max_examples=400)
@given(st.lists(event, max_size=60), st.integers(0, 2**32 - 1))
def test_nothing_raises_and_everything_shown_is_finite(events, seed):
    rng = np.random.default_rng(seed)
    estimator = OnlineEstimator(SMALL)
    try_to_configure(estimator, changes(rng, 0.0))
    now, fed = START, 0
    for kind, first, second in events:
        if kind == 'y':
            how, value = first
            now = now + value if how == 'ahead' else value
            estimator.update(now, second)
            fed += 1
        elif kind == 'set':
            try_to_configure(estimator, changes(np.random.default_rng(first), second))
        elif kind == 'u':
            estimator.set_input(first)
        elif first == 'reset':
            estimator.reset()
        else:
            estimator.policy.change(timed=False, tick_count=0)
        e = estimator.estimate
        assert e is None or np.isfinite([*e.z, e.unknown_input, e.gamma, *e.innovation]).all()
        counters = estimator.counters
        assert min(counters) >= 0
        assert counters.accepted + counters.rejected == fed


def try_to_configure(estimator: OnlineEstimator, values: dict) -> None:
    """Configure; where it is refused, check that the reason names a value and nothing changed."""
    before = estimator.parameters
    try:
        estimator.configure(values)
    except ConfigurationError as error:
        reason = str(error)
        assert any(f"'{name}'" in reason for name in values), reason
        assert 'expected' in reason
        assert '\n' not in reason
        assert estimator.parameters == before


def test_fixed_parameter_is_said_to_be_fixed():
    estimator = OnlineEstimator(SMALL)
    estimator.configure({'order': SMALL['order']})
    with pytest.raises(ConfigurationError, match="'order': can't change in a running obs"):
        estimator.configure({'order': 3, 'max_gap': 1.0})
    assert estimator.parameters == OnlineEstimator(SMALL).parameters
