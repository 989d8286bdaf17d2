# SPDX-License-Identifier: Apache-2.0
"""
What explains an external torque that does not go away: a setting that is wrong, or a payload.

One regression, with slow forgetting, of the external torque on what each mistake would make of it.
"""

from fhaosmo_ros.core.arm.model import ArmModel, Floats
import numpy as np

EVERY = 0.05
"""Seconds between two rows."""
MEMORY = 20.0
"""Seconds after which a row counts 1/e."""
LEAST = 5.0
"""Seconds of motion that are looked at before anything is said."""
EXPLAINED = 0.9
"""Share of the squared torque that a mistake has to explain."""
LARGE = 4.0
"""Times the model's error from which on a torque is worth explaining."""
MOVED = 0.1
"""rad (m): standard deviation of a posture in which a push may look like anything."""
SEEN = (1e-3, 1e-5)
"""Least shares of the excitation at which a direction of gravity, and a payload, can be told."""


class Doubts:
    """
    Looks for mistakes in what the external torques of an arm have in common.

    Parameters
    ----------
    model : ArmModel
    with_gravity : bool
        True if the torques are said to contain gravity.
    error : (n,) array
        Standard deviation of the model's error, N m.

    """

    def __init__(self, model: ArmModel, with_gravity: bool, error: Floats) -> None:
        self._model, self._with_gravity, self._error = model, with_gravity, error
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        n, self._time, self._seconds = len(self._error), 0.0, 0.0
        self.text, self.payload = '', False
        self._squares = np.zeros(n)  # of the torque, in the model's error
        self._weight = 0.0
        self._postures = np.zeros((n, 2))  # positions, and their squares
        self._own = np.zeros((n, 2))  # effort times torque, and its square, by joint
        self._normal = [np.zeros((k, k)) for k in (3, 4)]  # of gravity's vector, and a payload
        self._seen = [np.zeros(k) for k in (3, 4)]

    def take(self, h: float, q: Floats, effort: Floats, torque: Floats) -> None:
        """Look at a sample, `h` seconds after the one before; `torque` is the external one."""
        self._time += h
        if self._time < EVERY:
            return
        keep, self._time = np.exp(-self._time / MEMORY), 0.0
        rest = np.zeros(len(q))
        last = 10 * (len(q) - 1)
        payload = -self._model.regressor(q, rest, rest)[:, last : last + 4]
        columns = (self._model.gravity_columns(q), payload)
        scaled = torque / self._error
        self._seconds = self._seconds * keep + EVERY
        self._weight = self._weight * keep + 1.0
        self._squares = self._squares * keep + scaled**2
        self._postures = self._postures * keep + np.column_stack([q, q**2])
        self._own = self._own * keep + np.column_stack([effort * torque, effort**2])
        for k, column in enumerate(columns):
            a = column / self._error[:, np.newaxis]
            self._normal[k] = self._normal[k] * keep + a.T @ a
            self._seen[k] = self._seen[k] * keep + a.T @ scaled
        if self._seconds > LEAST:
            self._judge()

    def _judge(self) -> None:
        """Choose what explains the torque, if something does."""
        self.text, self.payload = '', False
        total, count = float(np.sum(self._squares)), len(self._squares)
        mean, square = self._postures.T / self._weight
        moved = float(np.max(square - mean**2)) > MOVED**2
        if not moved or total < LARGE**2 * self._weight * count:
            return
        slopes = self._own[:, 0] / np.maximum(self._own[:, 1], 1e-12)
        explained = self._own[:, 0] * slopes / self._error**2
        signs = (
            (np.abs(slopes + 2.0) < 0.5) & (explained > EXPLAINED * self._squares)
            & (self._squares > LARGE**2 * self._weight)
        )  # fmt: skip
        gravity, payload = (self._fit(k, total) for k in (0, 1))
        names = [n for n, wrong in zip(self._model.joints, signs, strict=True) if wrong]
        if gravity is not None:
            self.text = self._of_gravity(gravity)
        if not self.text and names:
            self.text = f'the effort of {", ".join(names)} has the wrong sign'
        if not self.text and payload is not None and payload[0] > 0.0:
            numbers = ', '.join(f'{x:.3g}' for x in (payload[0], *(payload[1:] / payload[0])))
            self.text = (
                f'the external torque is that of {payload[0]:.3g} kg more at the last link: if it '
                f'carries something, set the parameter payload to [{numbers}]'
            )
            self.payload = True

    def _fit(self, k: int, total: float) -> Floats | None:
        """Return the factors of a mistake that explains the torque, None if it does not."""
        values = np.linalg.eigvalsh(self._normal[k])
        if not values[0] > SEEN[k] * values[-1]:
            return None
        factors = np.asarray(np.linalg.solve(self._normal[k], self._seen[k]), dtype=np.float64)
        return factors if self._seen[k] @ factors > EXPLAINED * total else None

    def _of_gravity(self, factors: Floats) -> str:
        """Return what a change of gravity's vector means."""
        known = self._model.gravity
        seen = (known if self._with_gravity else np.zeros(3)) - factors
        size, expected = np.linalg.norm(seen), np.linalg.norm(known)
        if size < 0.3 * expected:
            return 'effort has no gravity in it: set the parameter effort to gravity_compensated'
        if not self._with_gravity:
            return 'effort has gravity in it: set the parameter effort to torque'
        cosine = seen @ known / (size * expected)
        if cosine < -0.9:
            return 'the efforts of all joints have the wrong sign'
        if cosine < 0.98 and 0.7 < size / expected < 1.4:
            text = ', '.join(f'{x:.2f}' for x in seen)
            return f'gravity is as if it were [{text}] in the frame of the base: parameter gravity'
        return ''
