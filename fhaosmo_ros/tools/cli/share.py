# SPDX-License-Identifier: Apache-2.0
"""Finding the files that ship with the package."""

import os
from pathlib import Path
import sys

from fhaosmo_ros.core.parameters.errors import ConfigurationError

PACKAGE = 'fhaosmo_ros'


def shipped(relative: str) -> Path:
    """
    Return the path of a shipped file, such as 'config/demo.yaml'.

    It looks beside the sources (a checkout, colcon build --symlink-install), then in the
    prefixes of a sourced workspace, then in the Python environment (pip install).

    Raises
    ------
    ConfigurationError
        The file is in none of these places.

    """
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    places = [Path(__file__).resolve().parents[3]]
    places += [Path(prefix) / 'share' / PACKAGE for prefix in [*prefixes, sys.prefix]]
    for place in places:
        if (place / relative).is_file():
            return place / relative
    raise ConfigurationError(
        f'{relative}: expected it in one of {", ".join(map(str, places))}, found it in none'
    )
