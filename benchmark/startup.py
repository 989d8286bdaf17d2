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
    """Return the seconds until the estimator is ready."""
    isolate()
    empty_starts, filled_starts = (1, 1) if quick else (3, 5)
    empty, filled = [], []
    with tqdm(
        total=empty_starts + filled_starts, desc='startup', unit='start', leave=False
    ) as progress:
        for _ in range(empty_starts):
            with TemporaryDirectory() as cache:
                empty.append(_start(cache))
                progress.update()
                for _ in range(filled_starts if len(empty) == empty_starts else 0):
                    filled.append(_start(cache))
                    progress.update()
    return [
        Row('estimator start, empty numba cache', float(np.median(empty)), 's', note=_all(empty)),
        Row('estimator start, cached', float(np.median(filled)), 's', note=_all(filled)),
    ]


def _start(cache: str) -> float:
    with Children() as children:
        estimator = children.start(
            'estimator', '-m', 'fhaosmo_ros', 'estimator', environment={'NUMBA_CACHE_DIR': cache}
        )
        return estimator.wait_for(READY)


def _all(times: list[float]) -> str:
    return 'from process start to ready: ' + ', '.join(f'{t:.2f}' for t in times)
