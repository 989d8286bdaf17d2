# SPDX-License-Identifier: Apache-2.0
"""
What a calibration of one day explains of another: motor currents of a UR10e that others recorded.

The folder has the files on that robot of shamilmamedov/dynamic_calibration (GitHub).
"""

import argparse
from dataclasses import replace
from pathlib import Path
import re

from fhaosmo_ros.core.arm.identification import identify, payload_of_motion
from fhaosmo_ros.core.arm.model import ArmModel, Calibration
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
import numpy as np
from studies.evidence import markdown
from studies.harness import Floats

FREE = ('ur-19_12_23_free.csv', 'ur-20_01_31-unload.csv')  # without payload, of two days


def main() -> int:
    """Calibrate on each day, judge on the other, and print what is left of the torques."""
    parser = argparse.ArgumentParser(prog='python -m studies.arm.ur10e', description=__doc__)
    parser.add_argument('folder', type=Path)

    def body(arguments: argparse.Namespace, stop: Stop) -> None:
        text = next(arguments.folder.rglob('UR10E_parameters.txt')).read_text(encoding='utf-8')
        constants = np.array(re.search(r'drvGains = \[(.*?)\]', text)[1].split(), dtype=np.float64)
        model = ArmModel(next(arguments.folder.rglob('ur10e.urdf')).read_text(encoding='utf-8'))
        days = [_recording(next(arguments.folder.rglob(name))) for name in FREE]
        for name, day, (t, q, current) in zip(FREE, days, days[::-1], strict=True):
            found = identify(model, *day, torque_constants=constants).calibration
            alone = replace(Calibration.of_urdf(model), torque_constants=constants)
            left = [payload_of_motion(model, t, q, current, c)[1] for c in (alone, found)]
            rows = [
                [joint, f'{urdf:.3g}', f'{after:.3g}', f'{after / urdf:.2f}']
                for joint, urdf, after in zip(model.joints, *left, strict=True)
            ]
            print(f'Calibrated on {name}, torque left on the other day, N m (RMS):\n')
            print(markdown(['joint', 'URDF', 'calibrated', 'ratio'], rows))

    return run_command(parser, None, body)


def _recording(path: Path) -> tuple[Floats, Floats, Floats]:
    """Return times (s), positions (rad) and currents (A) of a recording."""
    table = np.loadtxt(path, delimiter=',')
    return table[:, 0], table[:, 1:7], table[:, 13:19]


if __name__ == '__main__':
    raise SystemExit(main())
