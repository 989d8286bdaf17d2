# SPDX-License-Identifier: Apache-2.0
"""YAML as ROS 2 reads it."""

import re
from typing import Any

import yaml


class _Loader(yaml.SafeLoader):
    """Reads 1e-3 as a number, as rcl does; YAML 1.1 takes it for a text."""


_Loader.add_implicit_resolver(
    'tag:yaml.org,2002:float',
    re.compile(r'[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$'),
    list('-+.0123456789'),
)


def parse(text: str) -> Any:
    """
    Return the content of a YAML text.

    Raises
    ------
    yaml.YAMLError
        The text is not YAML.

    """
    return yaml.load(text, Loader=_Loader)  # noqa: S506  (a SafeLoader)
