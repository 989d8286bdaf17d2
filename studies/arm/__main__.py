# SPDX-License-Identifier: Apache-2.0
"""External torques of three simulated arms: ours beside other observers, tuned with the truth."""

import argparse
import sys

from studies.arm.judging import CALIBRATED, judged, OURS, SITUATIONS
from studies.arm.peers import PEERS
from studies.arm.world import ROBOTS
from studies.evidence import markdown
from studies.harness import Found, Results, run_study


def main(argv: list[str] | None = None) -> int:
    """Run the command; see `run_study`."""
    return run_study('arm', __doc__, measure, argv)


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Judge all observers on all arms."""
    duration = 10.0 if arguments.quick else 20.0
    cells = {
        (robot, source): (judged, robot, source == 'positions', duration, arguments.quick)
        for robot in ROBOTS for source in ('velocities', 'positions')
    }  # fmt: skip
    rows = [
        {'robot': robot, 'source': source, **row}
        for (robot, source), found in results(cells).items() for row in found
    ]  # fmt: skip
    lines = []
    for source in ('velocities', 'positions'):
        for name in [*PEERS, OURS, CALIBRATED]:
            own = [r for r in rows if r['source'] == source and r['observer'] == name]
            lines.append([
                source, name,
                *[' / '.join(f'{r[situation]:.2f}' for r in own) for situation in SITUATIONS],
                ' / '.join(f'{r["delay"]:.0f}, {r["delay p90"]:.0f}' for r in own),
                ' / '.join(f'{100.0 * r["overshoot"]:.0f}' for r in own),
            ])  # fmt: skip
    errors = (f'{s}, RMSE' for s in SITUATIONS)
    head = ('measured', 'observer', *errors, 'delay, 90 %, ms', 'overshoot, %')
    return Found({'arm': rows}, {'arm': markdown(head, lines)}, {})


if __name__ == '__main__':
    sys.exit(main())
