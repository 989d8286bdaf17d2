# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: how their arguments are declared."""

from collections.abc import Mapping
from typing import Any

CHOICES = {'log_level': ['debug', 'info', 'warn', 'error', 'fatal']}
"""Arguments that may have some values only."""


def declared(arguments: Mapping[str, tuple[Any, str]]) -> list[Any]:
    """Return launch's declarations of arguments: a default and a description by name."""
    from launch.actions import DeclareLaunchArgument  # not on PyPI, so not where it is not needed

    return [
        DeclareLaunchArgument(
            name, default_value=default, description=text, choices=CHOICES.get(name)
        )
        for name, (default, text) in arguments.items()
    ]
