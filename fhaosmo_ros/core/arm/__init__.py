# SPDX-License-Identifier: Apache-2.0
"""External torques and contacts of a robot arm."""

from fhaosmo_ros.core.arm.arm import Arm, ArmEstimate
from fhaosmo_ros.core.arm.model import ArmModel, Calibration

__all__ = ['Arm', 'ArmEstimate', 'ArmModel', 'Calibration']
