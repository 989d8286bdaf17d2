# SPDX-License-Identifier: Apache-2.0
"""The figure of `calibrate`."""

from collections.abc import Sequence

from fhaosmo_ros.core.arm.identification import Identified
from matplotlib.figure import Figure


def torque_figure(joints: Sequence[str], found: Identified) -> Figure:
    """Draw the measured torque of each joint, and what URDF and calibration say of it."""
    n = len(joints)
    figure = Figure((10.0, 1.3 * n + 1.0), layout='constrained')
    rows = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    t = found.t - found.t[0]
    for j, (axes, name) in enumerate(zip(rows, joints, strict=True)):
        axes.plot(t, found.by_urdf[:, j], color='tab:gray', lw=0.8, label='URDF')
        axes.plot(t, found.torque[:, j], color='black', lw=1.2, label='measured')
        axes.plot(t, found.by_calibration[:, j], color='tab:orange', lw=0.8, label='calibrated')
        axes.fill_between(
            t, 0, 1, where=found.held_out, transform=axes.get_xaxis_transform(), color='0.92',
            label='held out',
        )  # fmt: skip
        axes.set_title(f'{name}, N m', fontsize='small', loc='left')
    rows[0].legend(ncols=4, fontsize='small', loc='upper right')
    rows[-1].set_xlabel('time, s')
    figure.suptitle('Torque in free motion')
    return figure
