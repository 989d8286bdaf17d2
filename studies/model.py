# SPDX-License-Identifier: Apache-2.0
"""What a self-tuning observer is told: the model in a parameter file, and nothing else of it."""

from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.parameters.tables import CONSTANTS

SELF_TUNING = {'gains': 'self_tuning'}
NAMES = ('order', 'phi', 'inputs')


def model_alone(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that are the model."""
    return {k: v for k, v in parameters.items() if k in NAMES or k.startswith(CONSTANTS)}
