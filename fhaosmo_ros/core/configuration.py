# SPDX-License-Identifier: Apache-2.0
"""From checked parameters to what the kernel reads; here values are checked as a set."""

from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core import law, layout
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.fuzzy import curve, KNOTS, terms_of_level
from fhaosmo_ros.core.model import TriangularModel
from fhaosmo_ros.core.parameter import Parameter
from fhaosmo_ros.core.parameters import OBSERVER_PARAMETERS
import numpy as np

FIXED_GAMMA = 0.5
"""Power of the variants that do not adapt (paper eq. triangularObserver, fuzzysuper)."""


class ObserverConfiguration:
    """
    A valid set of observer parameters and the compiled law that it stands for.

    Parameters
    ----------
    parameters : mapping
        Values by name; defaults for the rest.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any]) -> None:
        values = OBSERVER_PARAMETERS.defaults() | OBSERVER_PARAMETERS.coerce(parameters)
        self.parameters: dict[str, Any] = values
        self.model = TriangularModel(self.parameters['phi'], self.parameters['order'])
        self._complete()

    def changed(self, changes: Mapping[str, Any]) -> 'ObserverConfiguration':
        """
        Return a configuration with some live parameters changed.

        Raises
        ------
        ConfigurationError
            As the constructor, or a change of a parameter that can't change live.

        """
        changes = OBSERVER_PARAMETERS.coerce(changes)
        for name, value in changes.items():
            if not OBSERVER_PARAMETERS[name].live and value != self.parameters[name]:
                raise ConfigurationError(
                    f"parameter '{name}': can't change in a running observer "
                    f'(it is {self.parameters[name]!r}), got {value!r}'
                )
        other = object.__new__(ObserverConfiguration)
        other.parameters = self.parameters | changes
        other.model = self.model
        other._complete()
        return other

    def _complete(self) -> None:
        p = self.parameters
        if not p['gamma_min'] <= p['gamma_initial'] <= p['gamma_max']:
            raise ConfigurationError(
                "parameters 'gamma_min', 'gamma_initial', 'gamma_max': expected each at most the "
                f'next one, got {p["gamma_min"]}, {p["gamma_initial"]}, {p["gamma_max"]}'
            )
        self.levant = p['structure'] == 'levant'
        if self.levant and not p['unknown_input']:
            raise ConfigurationError(
                "parameters 'structure', 'unknown_input': levant estimates the unknown input as "
                'its last level, expected unknown_input = true, got false'
            )
        if p['unknown_input_derivatives'] and not p['unknown_input']:
            raise ConfigurationError(
                "parameters 'unknown_input_derivatives', 'unknown_input': derivatives are levels "
                'behind that of the unknown input, expected unknown_input = true or '
                f'unknown_input_derivatives = 0, got false and {p["unknown_input_derivatives"]}'
            )
        if p['scheme'] == 'predict_correct' and not self.levant:
            raise ConfigurationError(
                "parameters 'scheme', 'structure': predict_correct is a scheme of levant alone, "
                "expected structure = 'levant' or another scheme (explicit, implicit), got "
                f'{p["structure"]!r} and {p["scheme"]!r}'
            )
        self.adaptive = p['variant'].endswith('_adaptive')
        self.gamma_initial = p['gamma_initial'] if self.adaptive else FIXED_GAMMA
        self.levels = self.model.order
        if p['unknown_input']:
            self.levels += 1 + p['unknown_input_derivatives']
        self.initial_estimate = self._per_level('initial_estimate')
        self.initial_internal = self._per_level('initial_internal')
        if self.levant:
            self.initial_internal = np.append(self.initial_estimate[1:], 0.0)
        self.internal = p['estimate_from'] == 'internal'
        n = self.model.order
        filtered = not self.internal and self.levels > n
        self.unknown_input_at = (layout.HAT, n) if filtered else (layout.TILDE, n - 1)
        self.law = self._make_law()

    def _per_level(self, name: str) -> np.ndarray:
        return per_level(OBSERVER_PARAMETERS[name], self.parameters[name], self.levels)

    def _make_law(self) -> law.Law:
        p, levels = self.parameters, self.levels
        widths = p['fuzzy_widths']
        if len(widths) > levels and widths != OBSERVER_PARAMETERS['fuzzy_widths'].default:
            raise OBSERVER_PARAMETERS['fuzzy_widths'].error(
                widths, f'1 to {levels} values (N = {levels} levels)'
            )
        widths = [widths[min(i, len(widths) - 1)] for i in range(levels)]
        flags = np.zeros(law.FLAGS, dtype=np.int64)
        flags[law.SIGN] = p['variant'].startswith('sign')
        flags[law.IMPLICIT] = p['scheme'] != 'explicit'
        flags[law.PREDICTING] = p['scheme'] == 'predict_correct'
        flags[law.ADAPTIVE] = self.adaptive
        flags[law.SENSITIVE] = self.adaptive and p['gamma_rate'] > 0.0
        flags[law.FROM_MEASUREMENT] = p['start_from_measurement']
        flags[law.LEVANT] = self.levant
        if flags[law.SIGN]:  # the kernel does not read them
            curves = np.ones((levels, KNOTS))
        else:
            curves = np.array(
                [
                    curve(terms_of_level(i + 1), p['fuzzy_shape'], p['fuzzy_normalise'])
                    for i in range(levels)
                ]
            )
        gains = np.zeros((law.GAINS, levels))
        gains[law.LAMBDA] = self._per_level('lambda')
        gains[law.ALPHA] = self._per_level('alpha')
        gains[law.INVERSE_WIDTH] = 1.0 / np.array(widths)
        decay, n = p['unknown_input_decay'], self.model.order
        modelled = slice(n - 1, -1 if p['unknown_input'] else None)  # d, d', .. but not theta
        gains[law.DECAY, modelled] = decay  # D 17, internal states
        tape, offsets = self.model.with_unknown_input(decay, p['unknown_input_derivatives'])
        scalars = np.zeros(law.SCALARS)
        scalars[law.EPSILON] = np.inf if self.levant else p['epsilon']  # no gates
        scalars[law.GAMMA_INITIAL] = p['gamma_initial']
        scalars[law.RATE] = p['gamma_rate']
        scalars[law.MIN] = p['gamma_min']
        scalars[law.MAX] = p['gamma_max']
        scalars[law.DEAD_ZONE] = p['gamma_dead_zone']
        scalars[law.LEAKAGE] = p['gamma_leakage']
        scalars[law.DELAY] = p['gamma_leakage_delay']
        scalars[law.PREDICTION_STEP] = p['prediction_step']
        scalars[law.CORRECTION_PERIOD] = p['correction_period']
        return law.Law(flags, gains, curves, scalars, tape, offsets)


def per_level(parameter: Parameter, values: list[float], count: int) -> np.ndarray:
    """Return one value a level from a list of 1 or `count` values, or raise."""
    if len(values) not in (1, count):
        raise parameter.error(values, f'1 or {count} values')
    return np.broadcast_to(np.array(values, dtype=np.float64), count).copy()
