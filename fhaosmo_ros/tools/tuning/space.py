# SPDX-License-Identifier: Apache-2.0
"""The search space made from names of estimator parameters, and parameters from its points."""

from collections.abc import Mapping, Sequence
from typing import Any

from fhaosmo_ros.core.parameters.declaration import Parameter, unknown_parameter
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.tools.tuning.search import Dimension, Values
import numpy as np

NUMBERS = ('double', 'double_array')
SMALLEST = 1e-12
"""Lower bound of a search in logarithms where the parameter itself may be 0."""
DECAYS = (1e-3, 1e2)
"""Bounds of unknown_input_decay (1/s) where neither user nor start set it."""


def make_space(
    search: Sequence[str], start: Mapping[str, Any], levels: int, decades: float
) -> list[Dimension]:
    """
    Return the dimensions of a search.

    Parameters
    ----------
    search : sequence of str
        As the parameter `search` says.
    start : mapping
        Complete parameters of the observer: where the search begins.
    levels : int
        Number of levels N.
    decades : float
        See the parameter `decades`.

    Raises
    ------
    ConfigurationError
        A name that is no numeric parameter of the observer, or bounds that it can't have.

    """
    space: list[Dimension] = []
    numbers = [p.name for p in OBSERVER_PARAMETERS.values() if p.kind in NUMBERS]
    for rule in search:
        name, *rest = rule.split() or ['']
        if name not in numbers:
            raise unknown_parameter(name, numbers)
        parameter = OBSERVER_PARAMETERS[name]
        if not _used(name, start):
            continue
        bounds, log = _bounds(rule, rest, parameter)
        if name == 'gamma_initial' and bounds is None:
            bounds = start['gamma_min'], start['gamma_max']
            log = bounds[1] > 10.0 * bounds[0]
        if name == 'unknown_input_decay' and bounds is None and not start[name]:
            bounds = DECAYS
        values, labels = [start[name]], [name]
        if parameter.kind == 'double_array':
            given = start[name]
            values = [given[min(k, len(given) - 1)] for k in range(levels)]
            labels = [f'{name}[{k}]' for k in range(levels)]
        for label, value in zip(labels, values, strict=True):
            low, high = bounds or _around(value, log, decades, parameter)
            if log and value < low:  # such as 0, which has no logarithm
                value = float(np.sqrt(low * high))
            space.append(Dimension(label, low, high, min(max(value, low), high), log))
    if not space:
        raise ConfigurationError(
            f"parameter 'search': expected one that the variant {start['variant']} uses, "
            f'got {list(search)!r}'
        )
    return space


def changes(values: Values) -> dict[str, Any]:
    """Return the parameters of the observer at a point of the space, whose dimensions name it."""
    found: dict[str, Any] = {}
    for label, value in values.items():
        name, level, _ = label.partition('[')
        if level:
            found.setdefault(name, []).append(value)
        else:
            found[name] = value
    return found


def _used(name: str, start: Mapping[str, Any]) -> bool:
    variant = str(start['variant'])
    if start['structure'] == 'levant' and name in ('alpha', 'epsilon', 'initial_internal'):
        return False
    if name.startswith('fuzzy_'):
        return variant.startswith('fuzzy')
    if name.startswith('gamma_'):
        return variant.endswith('_adaptive')
    return True


def _bounds(
    rule: str, rest: list[str], parameter: Parameter
) -> tuple[tuple[float, float] | None, bool]:
    """Return the bounds that a rule gives, and whether to search in logarithms."""
    lower = -np.inf if parameter.lower is None else parameter.lower
    upper = np.inf if parameter.upper is None else parameter.upper
    log = lower >= 0.0 and upper > 1.0
    if not rest:
        return None, log
    try:
        low, high = map(float, rest[:2])
    except ValueError:
        low = high = np.nan
    if len(rest) == 3:
        log = rest[2] == 'log'
    known = len(rest) == 2 or rest[2:] in (['log'], ['linear'])
    if not (known and lower <= low < high <= upper) or (log and low <= 0.0):
        raise ConfigurationError(
            f"parameter 'search': expected NAME, NAME LOW HIGH or NAME LOW HIGH log|linear with "
            f'bounds for {parameter.name} ({parameter.allowed}), got {rule!r}'
        )
    return (low, high), log


def _around(value: float, log: bool, decades: float, parameter: Parameter) -> tuple[float, float]:
    """Return the usual bounds around a start."""
    lower, upper = parameter.lower or 0.0, parameter.upper or 1.0
    if not log:
        return lower + 0.05 * (upper - lower), upper
    value = max(value, SMALLEST)
    return max(value / 10.0**decades, lower, SMALLEST), min(value * 10.0**decades, upper)
