# SPDX-License-Identifier: Apache-2.0
"""What has happened to the samples, one number for each case of docs/node.md."""

from typing import NamedTuple


class Counters(NamedTuple):
    """
    Numbers since the estimator was made; a snapshot. A reset does not clear them.

    The policy counts into a struct with these names (policy.pyx).
    """

    accepted: int = 0  # samples used
    # Samples that were not used:
    rejected_measurements: int = 0  # y was NaN, infinite or beyond 1e60
    rejected_spikes: int = 0  # y was beyond spike_gate, or 6 usual deviations, from its prediction
    rejected_stuck: int = 0  # y unchanged for stuck_time, or repeated although it has noise
    rejected_steps: int = 0  # the step would have left the finite numbers
    duplicate_stamps: int = 0  # the stamp of the sample before (sampling = source_stamp)
    backward_stamps: int = 0  # older than the sample before, by at most max_gap: a late sample
    zero_stamps: int = 0  # no time yet: use_sim_time before the first /clock, an unset header
    # More than max_gap from the stamp before: held until the next sample decides. Where that one
    # confirms the jump, the observer starts from the held sample after all.
    far_stamps: int = 0
    rejected_inputs: int = 0  # u was NaN or infinite; the one before is held

    gaps: int = 0  # intervals of more than twice the mean that were bridged in sub-steps
    sub_steps: int = 0  # steps that these took
    spread_stamps: int = 0  # at the clock time of the one before (sampling = clock): spread
    bursts: int = 0  # samples within a tenth of the mean interval after the one before
    spikes_believed: int = 0  # five samples in a row were beyond the gate: a real step of y
    stuck: int = 0  # times that y began to be stuck
    restarts_forward: int = 0  # after a gap longer than max_gap, or a clock that jumped forward
    restarts_backward: int = 0  # after a clock that jumped back (bag loop, simulator reset)
    divergences: int = 0  # times that the observer had lost y and was restarted from it
    jumps: int = 0  # times that y alone jumped, and the other estimates went on (D 23, D 35)

    @property
    def rejected(self) -> int:
        """Samples of y that were not used."""
        return (
            self.rejected_measurements + self.rejected_spikes + self.rejected_stuck
            + self.rejected_steps + self.duplicate_stamps + self.backward_stamps
            + self.zero_stamps + self.far_stamps
        )  # fmt: skip

    @property
    def restarts(self) -> int:
        """Starts from a new sample after a gap or a jump of time."""
        return self.restarts_forward + self.restarts_backward
