# SPDX-License-Identifier: Apache-2.0
"""Definitions of message types out of their classes, in the form that `find_field` reads."""

import re
from typing import Any

from fhaosmo_ros.messages.fields import ARRAY, BASE, NAME, SEQUENCE
from fhaosmo_ros.nodes.middleware.messages import message_class

OTHER_NAMES = {'double': 'float64', 'float': 'float32', 'boolean': 'bool'}
"""IDL's names, which classes have, and those of ROS."""


def definitions(message_type: str) -> dict[str, Any]:
    """
    Return the definitions of a message type and of all types in it.

    Raises
    ------
    LookupError
        One of them is not installed; see `message_class`.

    """
    found: dict[str, Any] = {}
    waiting = [message_type]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        fields = message_class(name).get_fields_and_field_types()
        found[name] = [], [(field, _node(text, waiting)) for field, text in fields.items()]
    return found


def _node(text: str, others: list[str]) -> Any:
    """Return the definition of a field; add the message types that it needs to `others`."""
    if inner := re.fullmatch(r'sequence<(.+?)(?:, *(\d+))?>', text):
        return SEQUENCE, (_node(inner[1], others), int(inner[2] or 0))
    if inner := re.fullmatch(r'(.+)\[(\d+)\]', text):
        return ARRAY, (_node(inner[1], others), int(inner[2]))
    if '/' in text:
        name = text.replace('/', '/msg/')
        others.append(name)
        return NAME, name
    kind = re.sub(r'<\d+>', '', text)  # string<10>
    return BASE, (OTHER_NAMES.get(kind, kind), 0)
