# SPDX-License-Identifier: Apache-2.0
"""What a sensor_msgs/msg/JointState, live or of a bag, says of the joints of an arm."""

from typing import Any

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray


def joint_sample(message: Any, arm: Arm) -> tuple[int, list[NDArray[np.float64]]]:
    """
    Return what `Arm.take` needs: the stamp in ns, and position, effort and perhaps velocity.

    Raise ConfigurationError where a joint, a number or the stamp is missing.
    """
    names, arrays = list(message.name), []
    if missing := [name for name in arm.joints if name not in names]:
        raise ConfigurationError(
            f'a message lacks {", ".join(missing)}{suggestion(missing[0], names)}'
        )
    order = [names.index(name) for name in arm.joints]
    measured = ['velocity'] * (arm.parameters['measurement'] == 'velocity')
    for what in ('position', 'effort', *measured):
        numbers = getattr(message, what)
        if len(numbers) != len(names):
            raise ConfigurationError(
                f'{what}: expected {len(names)} numbers, one for each name, got {len(numbers)}'
            )
        arrays.append(np.asarray(numbers, dtype=np.float64)[order])
    stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
    if stamp == 0:
        raise ConfigurationError('the header stamp is 0: nobody fills it')
    return stamp, arrays
