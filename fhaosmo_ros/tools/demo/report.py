# SPDX-License-Identifier: Apache-2.0
"""A recorded run of plant and estimator beside the truth, and a table of errors."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.metrics import chatter, rms
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import messages, Series, series
from fhaosmo_ros.tools.plot.curves import Curves, read_curves
from fhaosmo_ros.topics import ESTIMATES
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
START = 2.0
"""Seconds of the start that the table leaves out."""
RECENT = 50
"""Estimates over which the true noise is averaged."""
SELF_TUNING, HELD = 'self-tuning', 'fuzzy, the power held'
OTHERS: dict[str, dict[str, Any]] = {
    'sign, gains of the paper': {
        'variant': 'sign', 'scheme': 'explicit', 'lambda': [15.0], 'alpha': [30.0],
        'epsilon': 0.025, 'noise_size': 0.0,
    },
    HELD: {'gamma_rate': 0.0, 'gamma_leakage': 0.0},
    SELF_TUNING: {'gains': 'self_tuning'},
}  # fmt: skip
"""Observers that go through the same y: how their parameters differ from those of the file."""
WORDS = """
Error: RMS of the estimate of d minus d. Chatter: how much further the estimate moves than d does
(1: no chatter). The first observer ran live; the others went through the same y afterwards, by
the same code. Self-tuning is not the paper's observer: it is a bank of Kalman filters that is told
the model alone.
"""


class Run(NamedTuple):
    """Estimates beside the truth at the time of the sample that each was computed from, K rows."""

    curves: Curves
    truth: Floats  # (K, n + 1) of the curves
    y: Series  # all samples
    rows: NDArray[np.int64]  # (K,) the sample behind each estimate
    counters: dict[str, str]  # of the estimator's last diagnostics

    @property
    def t(self) -> Floats:
        """Seconds since the first estimate."""
        return np.asarray((self.curves.stamps - self.curves.stamps[0]) * 1e-9)

    @property
    def errors(self) -> Floats:
        """Errors of states and d, (K, n + 1)."""
        return self.curves.estimate - self.truth


def read_run(bag: Path) -> Run:
    """
    Read the bag of a demonstration.

    Each estimate is compared with the truth of the sample behind it (``~/stamp``), not with that
    of the moment at which it was published.

    Raises
    ------
    ConfigurationError
        The bag holds no estimate with its truth.

    """
    y = series(bag, '/y')
    with BagReader(bag) as reader:
        begun = all(reader.count(f'/estimator/{topic}') for topic in ESTIMATES)
    live = read_curves(bag, ['/estimator'], '/plant')[0] if begun else None
    if not live or live.truth is None or not np.isfinite(live.truth).all(axis=1).any():
        raise ConfigurationError('the run ended before an estimate arrived beside its truth')
    curves = live.part(np.isfinite(live.truth).all(axis=1))._replace(label='estimated live')
    counters: dict[str, str] = {}
    for _, message in messages(bag, '/diagnostics'):
        for status in message.status:
            if 'estimator' in status.name:
                counters |= {pair.key: pair.value for pair in status.values}
    rows = np.searchsorted(y.stamps, curves.stamps).clip(max=len(y.stamps) - 1)
    return Run(curves, np.asarray(curves.truth), y, rows, counters)


def others(run: Run, parameters: Mapping[str, Any]) -> dict[str, Floats]:
    """Return d as `OTHERS` estimate it from the same samples; nothing if gains tune themselves."""
    if parameters.get('gains') == 'self_tuning':
        return {}
    return {
        name: OnlineEstimator({**parameters, **changes})
        .run(run.y.stamps, run.y.values.ravel())
        .unknown_input[run.rows]
        for name, changes in OTHERS.items()
    }


def table(run: Run, compared: Mapping[str, Floats], marks: Sequence[tuple[int, str]]) -> str:
    """
    Return a report: how each observer estimates d, then states and samples.

    `marks` says when something changed (stamps in ns), and what.
    """
    origin = run.y.stamps[run.rows[0]]
    edges = [START, *((stamp - origin) * 1e-9 for stamp, _ in marks), np.inf]
    parts = [
        (begin, part) for begin, end in pairwise(edges)
        if (part := (run.t >= begin) & (run.t < end)).any()
    ] or [(0.0, run.t >= 0.0)]  # fmt: skip
    d = run.truth[:, -1]
    estimates = {'this estimator, live': run.curves.estimate[:, -1], **compared}
    width = max(map(len, estimates))
    head = ''.join(f'{f"from {begin:.0f} s":>20}' for begin, _ in parts)
    lines = [
        f'{"d":{width}}{head}', f'{"":{width}}' + f'{"error":>12}{"chatter":>8}' * len(parts)
    ]  # fmt: skip
    for name, estimate in estimates.items():
        cells = (
            f' {rms((estimate - d)[part]):11.2g} {chatter(estimate[part], d[part]):7.3g}'
            for _, part in parts
        )
        lines.append(f'{name:{width}}' + ''.join(cells))
    sizes = ''.join(f'{rms(d[part]):12.2g}{"":8}' for _, part in parts)
    lines.append(f'{"RMS of d itself":{width}}{sizes}'.rstrip())
    late = run.t >= parts[0][0]
    if compared:
        live, held = rms(run.errors[late, -1]), rms((compared[HELD] - d)[late])
        lines.append(WORDS.rstrip())
        lines.append(f'The power that adapts changed the error by {live / held - 1.0:+.1%}.')
    errors = [
        f'{name} {rms(run.errors[late, k]):.2g}' for k, name in enumerate(run.curves.names[:-1])
    ]
    lines += ['', f'RMS errors of the states from {parts[0][0]:.0f} s on: {", ".join(errors)}']
    if run.curves.deviation is not None and run.curves.tuning is not None:
        lines.append(_found(run, run.curves.deviation[:, -1], run.curves.tuning[-1]))
    span = (run.y.stamps[-1] - run.y.stamps[0]) * 1e-9
    counts = [run.counters.get(f'samples {n}', '?') for n in ('accepted', 'lost', 'rejected')]
    lines.append(
        f'samples: {counts[0]} used, {counts[1]} dropped, {counts[2]} rejected; '
        f'{(len(run.y.stamps) - 1) / span if span > 0.0 else float("nan"):.1f} a second'
    )
    return '\n'.join(lines)


def _found(run: Run, deviation: Floats, tuning: Floats) -> str:
    """Return what a self-tuning estimator has found, in words."""
    known = np.isfinite(deviation) & (run.t > START)
    if not known.any():
        return 'the run was too short for the estimator to find the noise'
    error = np.abs(run.errors[known, -1])
    noise, _, bandwidth, *_ = tuning
    return (
        'd lay within two standard deviations of its estimate for '
        f'{np.mean(error <= 2.0 * deviation[known]):.0%} of the time\n'
        f'noise on y at the end: found {noise:.2g}, true {true_noise(run)[-1]:.2g}; '
        f'd is followed within {1.0 / bandwidth:.2g} s'
    )


def true_noise(run: Run) -> Floats:
    """Return the standard deviation of the latest y minus z1 behind each estimate."""
    wrong = run.y.values.ravel()[run.rows] - run.truth[:, 0]
    mean = np.convolve(wrong**2, np.full(RECENT, 1.0 / RECENT))[: len(wrong)]
    return np.asarray(np.sqrt(mean / np.minimum(1.0, np.arange(1, len(wrong) + 1) / RECENT)))
