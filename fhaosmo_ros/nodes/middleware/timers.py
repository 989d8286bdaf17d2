# SPDX-License-Identifier: Apache-2.0
"""Timers whose period is a live parameter."""

from rclpy.timer import Timer


def set_period(timer: Timer, seconds: float) -> None:
    """Change a timer's period; a timer that is cancelled stays so."""
    period = round(seconds * 1e9)
    if period != timer.timer_period_ns:
        waits = not timer.is_canceled()
        timer.timer_period_ns = period
        if waits:
            timer.reset()  # else the events executor waits for the end of the old period
