# SPDX-License-Identifier: Apache-2.0
"""The observer as a plain Python library: no middleware, no bag reader, no plotting."""

from fhaosmo_ros.core.compile_cache import compile_cache

with compile_cache():
    from fhaosmo_ros.core import channels, joint
    from fhaosmo_ros.core.counters import Counters
    from fhaosmo_ros.core.errors import ConfigurationError
    from fhaosmo_ros.core.family import Family, Recording
    from fhaosmo_ros.core.model import TriangularModel
    from fhaosmo_ros.core.observer import Estimate, Observer, ObserverState, Trajectory
    from fhaosmo_ros.core.online import OnlineEstimator
    from fhaosmo_ros.core.plant import Plant
    from fhaosmo_ros.core.status import Status
    from fhaosmo_ros.core.trial import Trial

__all__ = [
    'ConfigurationError',
    'Counters',
    'Estimate',
    'Family',
    'Observer',
    'ObserverState',
    'OnlineEstimator',
    'Plant',
    'Recording',
    'Status',
    'Trajectory',
    'Trial',
    'TriangularModel',
    'channels',
    'joint',
]
