# SPDX-License-Identifier: Apache-2.0
"""What `calibrate` finds about one arm, and its file."""

from dataclasses import asdict, dataclass

from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.core.parameters.declaration import shown
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray
import yaml

Floats = NDArray[np.float64]
WIDTHS = 0.01, 0.03, 0.1, 0.3  # rad/s: how fast friction changes its sign, tanh(velocity / width)


@dataclass(frozen=True)
class Calibration:
    """What is known of an arm beyond its URDF; zeros where nothing is."""

    joints: tuple[str, ...]
    inertial: Floats  # (n, 10) of each link in Pinocchio's order, without payload
    motor_inertia: Floats  # (n,) of rotors, as joints see it, kg m^2
    offset: Floats  # (n,) of the measured torque, N m
    viscous: Floats  # (n,) friction for a velocity, N m s/rad
    coulomb: Floats  # (n, k) friction for tanh(velocity / width) with each of `WIDTHS`, N m
    torque_constants: Floats  # (n,) N m for one unit of effort
    position_noise: Floats  # (n,) as the parameter, which counts where this is 0
    torque_noise: Floats  # (n,) likewise
    model_error: Floats  # (n,) likewise
    log_odds: float | Floats = 0.0  # of contact, once a minute in the free motion; 0: not known

    @classmethod
    def of_urdf(cls, model: ArmModel) -> 'Calibration':
        """Return that of an arm of which only the URDF is known."""
        none = np.zeros(len(model.joints))
        dry = np.zeros((len(none), len(WIDTHS)))
        return cls(
            model.joints, model.unloaded, none, none, none, dry, none + 1.0, none, none, none
        )

    def friction(self, velocity: Floats) -> Floats:
        """Return friction and offset at velocities (..., n), in N m."""
        dry = np.sum(self.coulomb * np.tanh(velocity[..., np.newaxis] / WIDTHS), axis=-1)
        return np.asarray(self.offset + self.viscous * velocity + dry)

    def dumps(self) -> str:
        """Return the text of the file."""
        values = {name: np.asarray(value).tolist() for name, value in asdict(self).items()}
        return yaml.safe_dump({'arm_calibration': values}, sort_keys=False, width=100)

    @classmethod
    def loads(cls, text: str) -> 'Calibration':
        """Return what a file says; raise ConfigurationError for one that is none, or not whole."""
        try:
            given = dict(yaml.safe_load(text)['arm_calibration'])
            joints = tuple(map(str, given.pop('joints')))
            arrays = {name: np.array(v, dtype=np.float64) for name, v in given.items()}
            found = cls(joints, **arrays)
        except (yaml.YAMLError, TypeError, KeyError, ValueError) as error:
            why = ' '.join(str(error).split())
            raise ConfigurationError(
                f'calibration: expected a file of `calibrate`, got {text[:40]!r} ({why})'
            ) from None
        n = len(joints)
        shapes = {'inertial': (n, 10), 'coulomb': (n, len(WIDTHS)), 'log_odds': ()}
        for name, array in arrays.items():
            shape = shapes.get(name, (n,))
            if array.shape != shape or not np.isfinite(array).all():
                raise ConfigurationError(
                    f'calibration: {name}: expected finite numbers of shape {shape}, got '
                    f'{shown(array)}'
                )
        return found
