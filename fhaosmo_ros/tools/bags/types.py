# SPDX-License-Identifier: Apache-2.0
"""Message types, QoS profiles and messages in CDR, for bags."""

from collections.abc import Mapping
import os
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)
FOREVER = {'sec': 9223372036, 'nsec': 854775807}
"""An unlimited duration."""
OFFERED_QOS = {
    'history': 'keep_last', 'depth': 10, 'reliability': 'reliable', 'durability': 'volatile',
    'deadline': FOREVER, 'lifespan': FOREVER, 'liveliness': 'automatic',
    'liveliness_lease_duration': FOREVER, 'avoid_ros_namespace_conventions': False,
}  # fmt: skip
"""QoS that this package's nodes offer; `ros2 bag play` publishes with it again."""
LATCHED_QOS = {**OFFERED_QOS, 'durability': 'transient_local'}
"""The same, but transient-local: a late subscriber still gets the last message."""


def learn(message_type: str) -> bool:
    """Look a type up in the sourced workspaces, add it to `TYPES`; return False if not found."""
    if message_type in TYPES.fielddefs:
        return True
    package, kind, name = message_type.split('/')
    for prefix in filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)):
        path = Path(prefix, 'share', package, kind, f'{name}.msg')
        if path.is_file():
            found = get_types_from_msg(path.read_text(encoding='utf-8'), message_type)
            names = re.findall(r"\(<Nodetype.NAME: 2>, '([^']+)'\)", repr(found[message_type]))
            if all(learn(other) for other in names):
                TYPES.register(found)
                return True
    return False


def serialise(message_type: str, **fields: Any) -> bytes:
    """Return a message of one of ROS's own types in CDR."""
    return bytes(TYPES.serialize_cdr(TYPES.types[message_type](**fields), message_type))


def labelled_array(names: list[str], values: NDArray[np.float64]) -> bytes:
    """Return a Float64MultiArray in CDR whose label lists its elements, as the nodes publish."""
    types, count = TYPES.types, len(names)
    dimension = types['std_msgs/msg/MultiArrayDimension'](
        label=','.join(names), size=count, stride=count
    )
    layout = types['std_msgs/msg/MultiArrayLayout'](dim=[dimension], data_offset=0)
    return serialise('std_msgs/msg/Float64MultiArray', layout=layout, data=values)


def header(stamp: int) -> Any:
    """Return a header with its stamp in nanoseconds."""
    second, nanosecond = divmod(stamp, 1_000_000_000)
    time = TYPES.types['builtin_interfaces/msg/Time'](sec=second, nanosec=nanosecond)
    return TYPES.types['std_msgs/msg/Header'](stamp=time, frame_id='')


def diagnostics(stamp: int, warns: bool, name: str, text: str, values: Mapping[str, str]) -> bytes:
    """Return a DiagnosticArray of one status in CDR, with its stamp in nanoseconds."""
    types = TYPES.types
    pair = types['diagnostic_msgs/msg/KeyValue']
    status = types['diagnostic_msgs/msg/DiagnosticStatus'](
        level=int(warns),
        name=name,
        message=text,
        hardware_id='',
        values=[pair(key=key, value=value) for key, value in values.items()],
    )
    return serialise('diagnostic_msgs/msg/DiagnosticArray', header=header(stamp), status=[status])
