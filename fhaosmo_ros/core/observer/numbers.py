# SPDX-License-Identifier: Apache-2.0
"""The numbers of a snapshot, checked as they come in: names, types, sizes, ranges, finiteness."""

from collections.abc import Mapping
import math
from numbers import Integral
from typing import Any

from fhaosmo_ros.core.parameters.declaration import shown
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

LARGEST = 1.8e300
"""No number is larger."""
INTEGERS = -(2**63), 2**63 - 1
COUNTS = 0, 2**62
YES_OR_NO = 0, 1
FINITE, NOT_NEGATIVE, AT_LEAST_1 = (-LARGEST, LARGEST), (0.0, LARGEST), (1.0, LARGEST)
RANGES: dict[str, tuple[float, float]] = {
    **dict.fromkeys(('pending', 'period', 'interval', 'since'), NOT_NEGATIVE),
    **dict.fromkeys(('watched', 'saturated', 'spacing'), NOT_NEGATIVE),
    **dict.fromkeys(('moved', 'time_of_bursts', 'samples_of_bursts'), NOT_NEGATIVE),
    **dict.fromkeys(('within_bursts', 'between_bursts'), NOT_NEGATIVE),
    'beyond': (0.0, math.inf), 'share_of_bursts': (0.0, 1.0),
    **dict.fromkeys(('spread', 'scale'), AT_LEAST_1),
    **dict.fromkeys(('spikes', 'tick_count', 'repeats'), COUNTS),
    **dict.fromkeys(('mean_interval', 'longest_mean'), COUNTS),
    'intervals': (0, 32), 'ticks': (0, 1024), 'repeated': (0.0, 1.0),
    'event': (0, 5), 'event_deviation': (0.0, math.inf), 'past_place': (0, 511),
    'past_count': (0, 512), 'corners': (0, 16),
}  # fmt: skip
"""Of what is remembered; other integers have 64 bits, other numbers are at most `LARGEST`."""


def checked(values: Mapping[str, Any], like: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the numbers and arrays that `like` names, each of the type and shape that it has there.

    Raises ConfigurationError where one is missing, of another type or shape, or out of its range.
    """
    found: dict[str, Any] = {}
    for name, value in like.items():
        if not isinstance(value, Integral):
            array = array_of(values, name, np.shape(value), *RANGES.get(name, FINITE))
            found[name] = array if array.ndim else float(array)
            continue
        least, most = YES_OR_NO if isinstance(value, bool) else RANGES.get(name, INTEGERS)
        number: Any = values.get(name)
        if not isinstance(number, Integral) or not least <= int(number) <= most:
            raise _refused(name, f'an integer of {least:g} to {most:g}', shown(number))
        found[name] = int(number)
    return found


def bounded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return numbers and arrays as `checked` takes them: those that have overflowed, at an end."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        array = np.asarray(value)
        known = array if name == 'y' else np.nan_to_num(array, posinf=math.inf, neginf=-math.inf)
        clipped = np.clip(known, *RANGES.get(name, FINITE))
        found[name] = clipped if array.ndim else float(clipped)
    return found


def array_of(
    values: Mapping[str, Any],
    name: str,
    shape: tuple[int, ...],
    least: float = -LARGEST,
    most: float = LARGEST,
) -> NDArray[np.float64]:
    """Return an array of that shape whose numbers are within that range; raise as `checked`."""
    what = f'finite numbers of shape {shape}' if shape else 'a number'
    if name not in values and 0 not in shape:  # an empty array has no entries
        raise _refused(name, what, 'none of that name')
    number = values.get(name, np.zeros(shape))
    try:
        array = np.asarray(number, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        raise _refused(name, what, shown(number)) from None
    if array.shape != shape:
        raise _refused(name, what, f'shape {array.shape}')
    within = (least <= array) & (array <= most)
    if name == 'y':  # not known before the first sample
        within |= np.isnan(array)
    if not within.all():
        raise _refused(name, f'{what} of {least:g} to {most:g}', shown(array))
    return array


def _refused(name: str, expected: str, got: str) -> ConfigurationError:
    return ConfigurationError(f"snapshot: '{name}': expected {expected}, got {got}")
