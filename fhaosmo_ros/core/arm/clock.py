# SPDX-License-Identifier: Apache-2.0
"""
The time between two samples, where stamps jitter more than the sampling does.

Many drivers sample by a clock of the robot's controller, and stamp what they got when a thread of
the host wakes up. A stamp that is 0.1 ms off makes a velocity of 10 % more, for one sample.
"""

from fhaosmo_ros.core.arm.model import Floats
import numpy as np

LONGEST = 200
"""Samples over which the stamps are evened out."""
KEEP = 0.995
"""Share of what was remembered that is still remembered one sample later."""
BETTER = 0.8
"""Even intervals are used where velocities by them are rough by this factor at most."""
LATE = 5
"""Stamps in a row, off by half a period or more, after which the even clock starts from there."""
LEARNT = 20
"""Intervals of which the median is the period that the even clock begins with."""
MISSING = 0.7
"""Share of a period by which a stamp has to be late until a sample is taken as missing."""


class Clock:
    """
    Intervals from stamps, or from these evened out: whichever makes the smoother velocities.

    Stamps are evened out by the least squares of a line (constant period) over the last samples,
    written as an alpha-beta filter; whole periods may be missing. `apart` says by how much the two
    differ at the latest sample, s.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.even, self.apart = False, 0.0
        self._phase = self._period = 0.0
        self._count = self._off = 0
        self._first: list[float] = []
        self._speeds: list[Floats] = []
        self._rough = np.zeros(2)

    def interval(self, h: float, moved: Floats) -> float:
        """Return the time in which the joints `moved` (n,); `h` is that of the stamps, in s."""
        even = self._evened(h)
        self.apart = abs(h - even)
        speeds = [moved / h, moved / even]
        if self._speeds:
            change = [
                float(np.sum((a - b) ** 2)) for a, b in zip(speeds, self._speeds, strict=True)
            ]
            self._rough = KEEP * self._rough + change
        self._speeds = speeds
        self.even = bool(self._rough[1] < BETTER * self._rough[0])
        return even if self.even else h

    def _evened(self, h: float) -> float:
        """Go on by a stamp, `h` after the one before, and return the even interval."""
        # The phase is that of the even clock, counted from the latest stamp.
        if not self._count:
            self._first.append(h)
            if len(self._first) == LEARNT:
                self._period, self._phase = float(np.median(self._first)), 0.0
                self._count = LEARNT // 2
                self._first.clear()
            return h
        since = h - self._phase
        steps = max(1, int(since / self._period + 1.0 - MISSING))
        off = since - steps * self._period
        if abs(off) > 0.5 * self._period:  # a stamp that says nothing, unless it goes on
            self._off += 1
            if self._off > 100 * LATE:
                self._count = self._off = 0
            self._phase = 0.0 if self._off % LATE == 0 else -off
            return steps * self._period
        self._off = 0
        self._count = n = min(self._count + 1, LONGEST)
        alpha, beta = 2.0 * (2.0 * n - 1.0) / (n * (n + 1.0)), 6.0 / (n * (n + 1.0))
        even = steps * self._period + alpha * off
        self._phase = even - since
        self._period += beta * off / steps
        return even
