# SPDX-License-Identifier: Apache-2.0
"""
What explains an external torque that does not go away: a setting that is wrong, or a payload.

One regression, with slow forgetting, of the external torque on what each mistake would make of it.
"""

from typing import Any

from fhaosmo_ros.core.arm.model import ArmModel, Floats, USUAL
import numpy as np

EVERY = 0.1  # s between two rows
MEMORY = 20.0  # s after which a row counts 1/e
LEAST = 5.0  # s of motion that are looked at before anything is said
EXPLAINED = 0.9  # share of the squared torque that a mistake has to explain
LARGE = 4.0  # times the model's error from which on a torque is worth explaining
MOVED = 0.1  # rad (m), standard deviation of a posture in which a push may look like anything
PUT_DOWN = 0.1  # share of the payload below which nothing is carried
# Least shares of the excitation at which a direction of gravity, and a payload, can be told.
SEEN = 1e-3, 1e-5


class Doubts:
    """
    Looks for mistakes in what the external torques of an arm have in common.

    `with_gravity`: torques are said to contain it. `error` (n,): of the model, N m. `text` says
    what is found, and `mild` whether it may be no mistake, so that estimates go on.
    """

    def __init__(self, model: ArmModel, with_gravity: bool, error: Floats) -> None:
        self._model, self._with_gravity, self._error = model, with_gravity, error
        self.reset()

    def reset(self) -> None:
        """Begin anew, as for another payload."""
        self._time = 0.0
        self._sums: list[Any] = [0.0] * 6
        self.text, self.mild = '', False

    def take(self, h: float, q: Floats, effort: Floats, torque: Floats) -> None:
        """Look at a sample, `h` seconds after the one before; `torque` is the external one."""
        self._time += h
        if self._time < EVERY:
            return
        keep, self._time = np.exp(-self._time / MEMORY), 0.0
        rest, last = np.zeros(len(q)), 10 * (len(q) - 1)
        payload = self._model.regressor(q, rest, rest)[:, last : last + 4]
        columns = np.column_stack([self._model.gravity_columns(q), -payload, np.diag(effort)])
        a, scaled = columns / self._error[:, np.newaxis], torque / self._error
        news = 1.0, q, q**2, scaled**2, a.T @ a, a.T @ scaled
        self._sums = [keep * old + new for old, new in zip(self._sums, news, strict=True)]
        if EVERY * self._sums[0] > LEAST:
            self.text = self._explanation()

    def _explanation(self) -> str:
        """Return what explains the torque, if something does."""
        count, mean, square, squares, normal, seen = self._sums
        own = np.diag(normal)[7:]  # of efforts
        moved = np.max(square / count - (mean / count) ** 2) > MOVED**2
        large = np.mean(squares) > LARGE**2 * count
        if large and own.any() and not moved:
            return self.text  # an arm that rests shows nothing new
        self.mild = False
        if (moved or large) and not own.any():
            return 'all efforts are zero: does the driver measure them?'
        if not large:
            return ''

        def fit(part: slice, least: float) -> tuple[Floats, float]:
            """Return the factors of a mistake, and the share of the torque that it explains."""
            values = np.linalg.eigvalsh(normal[part, part])
            if not values[0] > least * values[-1]:
                return 0.0 * values, 0.0
            factors = np.asarray(np.linalg.solve(normal[part, part], seen[part]))
            return factors, seen[part] @ factors / np.sum(squares)

        change, by_gravity = fit(slice(0, 3), SEEN[0])
        more, by_payload = fit(slice(3, 7), SEEN[1])
        if by_gravity > EXPLAINED:
            known = self._model.gravity
            gravity, usual = self._with_gravity * known - change, np.linalg.norm(known) or USUAL
            size = np.linalg.norm(gravity) / usual
            cosine = gravity @ known / (size * usual**2)
            if not self._with_gravity and size > 0.7:
                return 'effort has gravity in it: set the parameter effort to torque'
            if self._with_gravity and size < 0.3:
                return (
                    'effort has hardly any gravity in it: set the parameter effort to '
                    'gravity_compensated, or to current'
                )
            if cosine < -0.9:
                return 'the efforts of all joints have the wrong sign'
            if cosine < 0.98 and 0.7 < size < 1.4:
                text = ', '.join(f'{x:.1f}' for x in gravity)
                return f"gravity is as if it were [{text}] in the base's frame: parameter gravity"
            if self._with_gravity and cosine > 0.9 and by_gravity > by_payload:
                self.mild = True
                return (
                    f'effort is {size:.2g} times what the model needs against gravity: is it in '
                    'N m (parameter torque_constants), and has calibrate found the masses?'
                )
        slopes = seen[7:] / np.maximum(own, 1e-12)
        reverses = (np.abs(slopes + 2.0) < 0.5) & (squares > LARGE**2 * count)
        wrong = reverses & (seen[7:] * slopes > EXPLAINED * squares)
        if wrong.any():
            names = ', '.join(np.array(self._model.joints)[wrong])
            return f'the effort of {names} has the wrong sign'
        known = (self._model.inertial - self._model.unloaded)[-1, :4] * self._with_gravity
        mass, *moments = known + more
        if mass < PUT_DOWN * known[0]:
            mass, moments = 0.0, [0.0] * 3
        if by_payload < EXPLAINED or mass <= known[0] == 0.0:
            return ''
        self.mild = True
        numbers = ', '.join(f'{x:.3g}' for x in (mass, *(x / (mass or 1.0) for x in moments)))
        told = '' if self._with_gravity else ', and tell the controller, which compensates gravity'
        return (
            'the external torque is that of another payload: if the last link carries it, set the '
            f'parameter payload to [{numbers}]{told}'
        )
