# SPDX-License-Identifier: Apache-2.0
"""What a sensor_msgs/msg/JointState, live or of a bag, says of the joints of an arm."""

from functools import lru_cache
from typing import Any

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray


def joint_sample(message: Any, arm: Arm) -> tuple[int, list[Any]]:
    """
    Return what `Arm.take` needs: the stamp in ns, and position, effort and perhaps velocity.

    Raises
    ------
    ConfigurationError
        A joint, a number or the stamp is missing.

    """
    names = tuple(message.name)
    order, arrays = _order(names, arm.joints), []
    measured = ['velocity'] * (arm.parameters['measurement'] == 'velocity')
    for what in ('position', 'effort', *measured):
        numbers = getattr(message, what)
        if len(numbers) != len(names):
            raise ConfigurationError(
                f'{what}: expected {len(names)} numbers, one for each name, got {len(numbers)}'
            )
        arrays.append(numbers if order is None else np.asarray(numbers, dtype=np.float64)[order])
    stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    if stamp == 0:
        raise ConfigurationError('the header stamp is 0: nobody fills it')
    return stamp, arrays


@lru_cache(maxsize=16)  # messages of a driver have the same names
def _order(names: tuple[str, ...], joints: tuple[str, ...]) -> NDArray[np.intp] | None:
    """Return where each joint is among the names; None for the names in their order."""
    if missing := [name for name in joints if name not in names]:
        raise ConfigurationError(
            f'a message lacks {", ".join(missing)}{suggestion(missing[0], names)}'
        )
    if names == joints:
        return None
    return np.array([names.index(name) for name in joints])
