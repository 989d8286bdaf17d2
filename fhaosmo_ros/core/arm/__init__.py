# SPDX-License-Identifier: Apache-2.0
"""External torques and contacts of a robot arm."""

from fhaosmo_ros.core.arm.arm import Arm, ArmEstimate, ArmEstimates, Wrench
from fhaosmo_ros.core.arm.calibration import Calibration
from fhaosmo_ros.core.arm.model import ArmModel, Payload

__all__ = ['Arm', 'ArmEstimate', 'ArmEstimates', 'ArmModel', 'Calibration', 'Payload', 'Wrench']
