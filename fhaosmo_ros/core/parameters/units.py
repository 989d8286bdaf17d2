# SPDX-License-Identifier: Apache-2.0
"""Units that follow from the unit of y."""


def derivative_unit(unit: str, order: int) -> str:
    """Return the unit of a derivative with respect to time: 'rad/s^2'; '' if `unit` is ''."""
    if not unit or not order:
        return unit
    return f'{unit}/s' if order == 1 else f'{unit}/s^{order}'


def titled(name: str, unit: str) -> str:
    """Return a name with its unit, 'z1 [rad]', or alone without one."""
    return f'{name} [{unit}]' if unit else name
