# SPDX-License-Identifier: Apache-2.0
"""What `calibrate` finds about one arm, and its file."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray
import yaml

Floats = NDArray[np.float64]
WIDTHS = (0.01, 0.03, 0.1, 0.3)
"""rad/s: how fast friction changes its sign, tanh(velocity / width)."""


@dataclass(frozen=True)
class Calibration:
    """
    What is known of an arm beyond its URDF; zeros where nothing is.

    Attributes
    ----------
    joints : (n,) names
    inertial : (n, 10) array, or empty
        Of each link in Pinocchio's order, without payload; empty for the URDF's.
    motor_inertia : (n,) array
        Of rotors, as joints see it, kg m^2.
    offset : (n,) array
        Of the measured torque, N m.
    viscous : (n,) array
        Friction for a velocity, N m s/rad.
    coulomb : (n, k) array
        Friction for tanh(velocity / width) with each of `WIDTHS`, N m.
    torque_constants : (n,) array
        N m for one unit of effort.
    position_noise, torque_noise, model_error : (n,) array
        As the parameters; 0 for what these say.
    log_odds : float
        Of contact, reached once a minute in the free motion; 0 if not known.

    """

    joints: tuple[str, ...]
    inertial: Floats
    motor_inertia: Floats
    offset: Floats
    viscous: Floats
    coulomb: Floats
    torque_constants: Floats
    position_noise: Floats
    torque_noise: Floats
    model_error: Floats
    log_odds: float = 0.0

    @classmethod
    def none(cls, joints: Sequence[str]) -> 'Calibration':
        """Return that of an arm of which only the URDF is known."""
        n = len(joints)
        zeros = np.zeros(n)
        return cls(
            tuple(joints), np.zeros((0, 10)), zeros, zeros, zeros, np.zeros((n, len(WIDTHS))),
            np.ones(n), zeros, zeros, zeros,
        )  # fmt: skip

    def changed(self, **values: Any) -> 'Calibration':
        """Return these values with some changed."""
        return replace(self, **values)

    def friction(self, velocity: Floats) -> Floats:
        """Return friction and offset at velocities (..., n), in N m."""
        shares = np.tanh(velocity[..., np.newaxis] / np.array(WIDTHS))
        return np.asarray(
            self.offset + self.viscous * velocity + np.sum(self.coulomb * shares, axis=-1)
        )

    def dumps(self) -> str:
        """Return the text of the file."""
        values = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in asdict(self).items()
        }
        values['joints'] = list(self.joints)
        return yaml.safe_dump({'arm_calibration': values}, sort_keys=False, width=100)

    @classmethod
    def loads(cls, text: str) -> 'Calibration':
        """
        Return what a file says.

        Raises
        ------
        ConfigurationError
            Not such a file, a missing or unknown name, another size, a number that is not finite.

        """
        try:
            given = yaml.safe_load(text)['arm_calibration']
            names = tuple(str(name) for name in given['joints'])
            known = {f.name for f in fields(cls)}
            if set(given) != known:
                wrong = ', '.join(sorted(set(given) ^ known))
                raise ConfigurationError(f'calibration: missing or unknown are {wrong}')
            sizes = cls.none(names)
            values: dict[str, Any] = {'log_odds': float(given['log_odds'])}
            for f in fields(cls)[1:-1]:
                array = _finite(f.name, given[f.name])
                shape = getattr(sizes, f.name).shape
                if f.name == 'inertial':
                    array, shape = array.reshape(-1, 10), (len(array), 10)
                    if len(array) not in (0, len(names)):
                        shape = (len(names), 10)
                if array.shape != shape:
                    raise ConfigurationError(
                        f'calibration: {f.name}: expected shape {shape}, got {array.shape}'
                    )
                values[f.name] = array
        except (yaml.YAMLError, TypeError, KeyError, ValueError) as error:
            if isinstance(error, ConfigurationError):
                raise
            raise ConfigurationError(
                f'calibration: expected a file of `calibrate`, got {text[:40]!r} ({error})'
            ) from None
        return cls(joints=names, **values)

    def of(self, joints: Sequence[str]) -> 'Calibration':
        """
        Return the same for the joints in this order.

        Raises
        ------
        ConfigurationError
            They are not those of the file.

        """
        if set(joints) != set(self.joints):
            raise ConfigurationError(
                f'calibration: expected the joints {", ".join(joints)}, '
                f'got {", ".join(self.joints)}'
            )
        if len(self.inertial) and tuple(joints) != self.joints:
            raise ConfigurationError('calibration: expected the joints in the order of the URDF')
        order = [self.joints.index(name) for name in joints]
        arrays = {
            f.name: getattr(self, f.name)[order]
            for f in fields(self)[2:-1]
        }  # fmt: skip
        return replace(self, joints=tuple(joints), **arrays)


def _finite(name: str, value: ArrayLike) -> Floats:
    array = np.array(value, dtype=np.float64)
    if not np.isfinite(array).all():
        raise ConfigurationError(f'calibration: {name}: expected finite numbers, got others')
    return array
