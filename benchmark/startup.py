# SPDX-License-Identifier: Apache-2.0
"""From the start of an estimator to its first word, with an empty and with a filled cache."""

from tempfile import TemporaryDirectory

from children import Children
import numpy as np
from rates import isolate
from table import Row
from tqdm import tqdm

READY = 'estimating'


def measure(quick: bool) -> list[Row]:
    """Return the seconds until the estimator is ready: with fixed gains, and self-tuning."""
    isolate()
    starts = 1 if quick else 5
    gains = ('fixed',) if quick else ('fixed', 'self_tuning')
    rows = []
    with tqdm(
        total=len(gains) * (1 + starts), desc='startup', unit='start', leave=False
    ) as progress:
        for kind in gains:
            times = []
            with TemporaryDirectory() as cache:
                for _ in range(1 + starts):
                    times.append(_start(cache, kind))
                    progress.update()
            for name, found in (('empty', times[:1]), ('filled', times[1:])):
                wall, processor = np.median(found, axis=0)
                note = f'to its first word; {processor:.2g} s of CPU; {_all(found)}'
                title = f'estimator start, gains {kind}, {name} cache of machine code'
                rows.append(Row(title, float(wall), 's', note=note))
    return rows


def _start(cache: str, gains: str) -> tuple[float, float]:
    """Return the seconds and the CPU time until the estimator is ready."""
    with Children() as children:
        estimator = children.start(
            'estimator', '-m', 'fhaosmo_ros', 'estimator', '--ros-args', '-p', f'gains:={gains}',
            environment={'NUMBA_CACHE_DIR': cache},
        )  # fmt: skip
        return estimator.wait_for(READY), estimator.cpu_seconds()


def _all(times: list[tuple[float, float]]) -> str:
    return ', '.join(f'{wall:.2f}' for wall, _ in times)
