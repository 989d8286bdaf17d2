# SPDX-License-Identifier: Apache-2.0
"""The observer as a plain Python library: no middleware, no bag reader, no plotting."""

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import Event, EventDetector
from fhaosmo_ros.core.online.policy import Counters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.plant import Plant
from fhaosmo_ros.core.simulation.recordings import Family, Recording

__all__ = [
    'ConfigurationError',
    'Counters',
    'Estimate',
    'Event',
    'EventDetector',
    'Family',
    'Observer',
    'OnlineEstimator',
    'Plant',
    'Recording',
    'Status',
    'Trajectory',
    'TriangularModel',
]
