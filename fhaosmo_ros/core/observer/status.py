# SPDX-License-Identifier: Apache-2.0
"""What a step reports beside its estimate: one integer, readable as flags and a level count."""

from enum import IntFlag

LEVEL_SHIFT = 16
"""Bits from here on hold the number of open levels, those below it the flags."""


class Status(IntFlag):
    """
    Flags of a step. The number of open levels is kept apart: see `Estimate.open_levels`.

    A rejected sample leaves the state as it was. The time it stood for is added to the next step,
    except for `REJECTED_STEP`, which drops it, so that what could not be stepped over does not
    come back. The flags after `SENSITIVITY_RESET` come from the policy of core/online only.
    """

    OK = 0
    REJECTED_MEASUREMENT = 1  # y is NaN or infinite
    REJECTED_PERIOD = 2  # dt is not a positive finite number
    REJECTED_INPUT = 4  # u is NaN or infinite
    REJECTED_STEP = 8  # the step would have left the finite numbers
    GAMMA_AT_MIN = 16
    GAMMA_AT_MAX = 32
    SENSITIVITY_RESET = 64  # the sensitivities grew beyond use and start again at 0
    REJECTED_SPIKE = 128  # y is too far from its prediction: spike_gate, or 6 usual deviations
    REJECTED_STUCK = 256  # y is as before for stuck_time, or repeats itself although it has noise
    HELD = 512  # with REJECTED_PERIOD: a jump of the stamp; the next sample decides
    GAP = 1024  # a long interval was bridged in sub-steps
    RESTARTED = 2048  # started afresh after a gap or a jump of the clock
    DIVERGED = 4096  # the estimate had lost y and was restarted from it
    JUMPED = 8192  # y alone has jumped; the other estimates go on, now or with the next sample
    REPEATED = 16384  # y repeats a value that its sensor holds: nothing is learned from it

    @property
    def rejected(self) -> bool:
        """True if the sample was not used."""
        return bool(int(self) & REJECTED)


# Masks are plain integers: an IntFlag costs microseconds in a path that runs at 1 kHz.
REJECTED = int(
    Status.REJECTED_MEASUREMENT | Status.REJECTED_PERIOD | Status.REJECTED_INPUT
    | Status.REJECTED_STEP | Status.REJECTED_SPIKE | Status.REJECTED_STUCK
)  # fmt: skip
"""Mask of the flags that say that a sample was not used."""
UNUSED = REJECTED | int(Status.REPEATED)
"""The same, and that it repeats a value which its sensor holds: the estimate is of that one."""
AFRESH = int(Status.RESTARTED | Status.DIVERGED)
"""Mask of the flags that say that the observer began anew."""
JUMPED = int(Status.JUMPED)
