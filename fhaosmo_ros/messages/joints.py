# SPDX-License-Identifier: Apache-2.0
"""What a sensor_msgs/msg/JointState, live or of a bag, says of the joints of an arm."""

from collections.abc import Sequence
from typing import Any

from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray


def joint_sample(
    message: Any, joints: Sequence[str], with_velocity: bool
) -> tuple[int, list[NDArray[np.float64]]]:
    """
    Return the stamp in ns, and position, effort and perhaps velocity in the order of `joints`.

    Raises
    ------
    ConfigurationError
        A joint, a number or the stamp is missing.

    """
    names = message.name
    missing = [name for name in joints if name not in names]
    if missing:
        raise ConfigurationError(
            f'a message lacks {", ".join(missing)}{suggestion(missing[0], names)}'
        )
    order, arrays = [names.index(name) for name in joints], []
    for what in ('position', 'effort', *['velocity'] * with_velocity):
        array = np.asarray(getattr(message, what), dtype=np.float64)
        if len(array) != len(names):
            raise ConfigurationError(
                f'{what}: expected {len(names)} numbers, one for each name, got {len(array)}'
            )
        arrays.append(array[order])
    stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    if stamp == 0:
        raise ConfigurationError('the header stamp is 0: nobody fills it')
    return stamp, arrays
