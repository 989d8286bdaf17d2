# SPDX-License-Identifier: Apache-2.0
"""Compile the numerical core, so that the first start of a node need not do it."""

import argparse
from time import perf_counter

from fhaosmo_ros.core.compiled.cache import cache_folder
from fhaosmo_ros.core.observer.fuzzy import curves, SHAPES
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.online.batch import EstimatorBatch
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import EventDetector
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.plant import Plant
from fhaosmo_ros.core.simulation.recordings import Family
from fhaosmo_ros.core.simulation.scoring import Trial
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.mcap import chunks
from fhaosmo_ros.tools.cli.command import run_command
import numpy as np


def main(argv: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog='compile',
        description='Compile what the nodes, replay and tune need, and keep it in the cache.',
    )
    return run_command(parser, argv, _compile)


def _compile(_: argparse.Namespace, stop: Stop) -> None:
    folder = cache_folder()
    if folder is None:
        raise ConfigurationError('expected a folder to keep compiled code in, found none')
    begin = perf_counter()
    with stop.raising():
        _call_everything()
    print(f'compiled in {perf_counter() - begin:.1f} s: {folder}')


def _call_everything() -> None:
    """Do in small what the nodes, replay and tune do."""
    for shape in SHAPES:
        curves(OBSERVER_PARAMETERS.complete({'fuzzy_shape': shape}), levels=2)
    estimator = OnlineEstimator()
    estimator.advance(1, 0.0)
    estimator.run(np.array([2, 3]), np.zeros(2), np.zeros(2))
    OnlineEstimator({'gains': 'self_tuning'})
    EventDetector(estimator.parameters | {'event_threshold': 1.0}).take([1], [0.0])
    EstimatorBatch([OnlineEstimator()]).advance([0], [1], [0.0], [0.0])
    t = np.arange(3) * 1e-3
    Observer(ESTIMATOR_PARAMETERS.complete({})).run(t, np.zeros(3), np.zeros(3))
    plant = Plant()
    plant.sample(0.0)
    plant.simulate(t)
    Trial([Family({'duration': 0.1}).recording(0)], {}, settled=0.05, band=0.1)({})
    chunk = np.frombuffer(bytes(chunks.CHANNEL_AT), dtype=np.uint8)  # a record without data
    records = chunks.scan(chunk, [])
    chunks.copy(chunk, records, records.channels)
