# SPDX-License-Identifier: Apache-2.0
"""From the start of an estimator to its first word."""

from children import Children
import numpy as np
from rates import isolate
from table import Row
from tqdm import tqdm

READY = 'estimating'
BAR = 2.0


def measure(quick: bool) -> list[Row]:
    """Return the seconds until the estimator is ready: with fixed gains, and self-tuning."""
    isolate()
    starts = 1 if quick else 5
    gains = ('fixed',) if quick else ('fixed', 'self_tuning')
    rows = []
    with tqdm(total=len(gains) * starts, desc='startup', unit='start', leave=False) as progress:
        for kind in gains:
            found = []
            for _ in range(starts):
                found.append(_start(kind))
                progress.update()
            wall, processor = np.median(found, axis=0)
            note = f'to its first word; {processor:.2g} s of CPU; {_all(found)}'
            rows.append(Row(f'estimator start, gains {kind}', float(wall), 's', BAR, note))
    return rows


def _start(gains: str) -> tuple[float, float]:
    """Return the seconds and the CPU time until the estimator is ready."""
    with Children() as children:
        estimator = children.start(
            'estimator', '-m', 'fhaosmo_ros', 'estimator', '--ros-args', '-p', f'gains:={gains}',
        )  # fmt: skip
        return estimator.wait_for(READY), estimator.cpu_seconds()


def _all(times: list[tuple[float, float]]) -> str:
    return ', '.join(f'{wall:.2f}' for wall, _ in times)
