# SPDX-License-Identifier: Apache-2.0
"""From checked parameters to the arrays of a law; here values are checked as a set."""

from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.model.triangular import constants_of, TriangularModel
from fhaosmo_ros.core.observer import arrays
from fhaosmo_ros.core.observer.covariance import Uncertainty
from fhaosmo_ros.core.observer.fuzzy import curves, KNOTS, of_level, read_system
from fhaosmo_ros.core.observer.levant import deadbeat_shares
from fhaosmo_ros.core.observer.self_tuning.members import ORDERS, rows_of
from fhaosmo_ros.core.parameters.declaration import Parameter
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
import numpy as np

FIXED_GAMMA = 0.5
"""Power of the variants that do not adapt (paper eq. triangularObserver, fuzzysuper)."""


class ObserverConfiguration:
    """
    A valid set of observer parameters and the compiled law that it stands for.

    Parameters
    ----------
    parameters : mapping
        Values by name, checked here unless they are `Parameters`; defaults for the rest.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any]) -> None:
        self.parameters = OBSERVER_PARAMETERS.complete(parameters)
        self.model = TriangularModel.of(self.parameters)
        self._complete()

    def changed(self, changes: Mapping[str, Any]) -> 'ObserverConfiguration':
        """
        Return a configuration with some live parameters changed.

        Parameters
        ----------
        changes : mapping
            Values to change, or complete `Parameters`.

        Raises
        ------
        ConfigurationError
            As the constructor, or a change of a parameter that can't change live.

        """
        other = object.__new__(ObserverConfiguration)
        other.parameters = self.parameters.changed_live(changes, 'observer')
        other.model = self.model
        if constants_of(other.parameters) != constants_of(self.parameters):
            other.model = TriangularModel.of(other.parameters)
        other._complete()
        return other

    def _complete(self) -> None:
        p = self.parameters
        if not p['gamma_min'] <= p['gamma_initial'] <= p['gamma_max']:
            raise ConfigurationError(
                "parameters 'gamma_min', 'gamma_initial', 'gamma_max': expected each at most the "
                f'next one, got {p["gamma_min"]}, {p["gamma_initial"]}, {p["gamma_max"]}'
            )
        self.self_tuning = p['gains'] == 'self_tuning'
        if self.self_tuning:
            self._complete_self_tuning()
            return
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
        sizes = OBSERVER_PARAMETERS['state_sizes']
        self.state_sizes = per_level(sizes, p['state_sizes'], self.model.order)
        if self.levant:
            self.initial_internal = np.append(self.initial_estimate[1:], 0.0)
        self.internal = p['estimate_from'] == 'internal'
        n = self.model.order
        filtered = not self.internal and self.levels > n
        self.unknown_input_at = (arrays.HAT, n) if filtered else (arrays.TILDE, n - 1)
        self.law = self._make_law()

    def _complete_self_tuning(self) -> None:
        p, n = self.parameters, self.model.order
        if not p['unknown_input']:
            raise ConfigurationError(
                "parameters 'gains', 'unknown_input': self_tuning follows the unknown input, "
                'expected unknown_input = true, got false'
            )
        self.levant, self.internal, self.adaptive, self.gamma_initial = True, False, False, 0.0
        self.levels = n + ORDERS
        self.initial_estimate = self.initial_internal = np.zeros(self.levels)
        self.state_sizes = per_level(OBSERVER_PARAMETERS['state_sizes'], p['state_sizes'], n)
        self.unknown_input_at = arrays.HAT, n
        flags = np.zeros(arrays.FLAGS, dtype=np.int64)
        for flag in (arrays.IMPLICIT, arrays.LEVANT, arrays.PREDICTING, arrays.SELF_TUNING):
            flags[flag] = 1
        flags[arrays.FROM_MEASUREMENT] = p['start_from_measurement']
        flags[arrays.LINEAR] = self.model.is_linear
        scalars = np.zeros(arrays.SCALARS)
        scalars[[arrays.EPSILON, arrays.WIDEST]] = np.inf  # no gates, no growth
        scalars[arrays.PREDICTION_STEP] = p['prediction_step']
        scalars[arrays.FORGETTING] = p['tuning_memory']
        scalars[arrays.SLIDER] = p['bandwidth']
        scalars[arrays.LEAST_NOISE] = p['noise_size']
        chances = np.zeros((arrays.SINGLE * self.levels + arrays.SINGLES, self.levels))
        diagonal = arrays.FRESH * self.levels + np.arange(n), np.arange(n)
        chances[diagonal] = self.state_sizes**2
        gains = np.ones((arrays.GAINS, self.levels))
        model = self.model.with_unknown_input(0.0, ORDERS - 1)
        curves = np.ones((self.levels, KNOTS))
        self.law = arrays.Law(flags, gains, curves, scalars, chances, model)

    def initial_state(self) -> arrays.State:
        """Return the state of an observer that has seen no sample."""
        rows = arrays.ROWS + self.levels
        if self.self_tuning:
            rows += rows_of(self.model.order)
        levels, memory = np.zeros((rows, self.levels)), np.zeros(arrays.MEMORY)
        levels[arrays.HAT] = self.initial_estimate
        levels[arrays.TILDE] = self.initial_internal
        if self.self_tuning:
            levels[arrays.COVARIANCE] = np.inf
        else:
            levels[arrays.COVARIANCE :] = self.law.chances[arrays.part(arrays.FRESH, self.levels)]
        memory[arrays.GAMMA] = self.gamma_initial
        memory[arrays.Y] = np.nan
        memory[arrays.SCALE] = memory[arrays.SPREAD] = 1.0
        memory[arrays.SETTLED] = 1.0 - self.law.flags[arrays.SCHEDULED]
        return arrays.State(levels, memory)

    def _per_level(self, name: str) -> np.ndarray:
        return per_level(OBSERVER_PARAMETERS[name], self.parameters[name], self.levels)

    def _make_law(self) -> arrays.Law:
        p, levels = self.parameters, self.levels
        for name in ('fuzzy_widths', 'fuzzy_systems'):
            declared = OBSERVER_PARAMETERS[name]
            if len(p[name]) > levels and p[name] != declared.default:
                raise declared.error(p[name], f'1 to {levels} values (N = {levels} levels)')
        widths = [of_level(p['fuzzy_widths'], i) for i in range(levels)]
        flags = np.zeros(arrays.FLAGS, dtype=np.int64)
        flags[arrays.SIGN] = p['variant'].startswith('sign')
        flags[arrays.IMPLICIT] = p['scheme'] != 'explicit'
        flags[arrays.PREDICTING] = p['scheme'] == 'predict_correct'
        flags[arrays.ADAPTIVE] = self.adaptive
        flags[arrays.SENSITIVE] = self.adaptive and p['gamma_rate'] > 0.0
        flags[arrays.FROM_MEASUREMENT] = p['start_from_measurement']
        flags[arrays.LEVANT] = self.levant
        if flags[arrays.SIGN]:  # the curves are not read
            for text in p['fuzzy_systems']:
                read_system(text, p['fuzzy_shape'])
            psi = np.ones((levels, KNOTS))
        else:
            psi = curves(p, levels)
        gains = np.zeros((arrays.GAINS, levels))
        gains[arrays.LAMBDA] = self._per_level('lambda')
        gains[arrays.ALPHA] = self._per_level('alpha')
        gains[arrays.INVERSE_WIDTH] = 1.0 / np.array(widths)
        decay, n = p['unknown_input_decay'], self.model.order
        modelled = slice(n - 1, -1 if p['unknown_input'] else None)  # d, d', .. but not theta
        gains[arrays.DECAY, modelled] = decay  # D 17, internal states
        model = self.model.with_unknown_input(decay, p['unknown_input_derivatives'])
        scalars = np.zeros(arrays.SCALARS)
        scalars[arrays.EPSILON] = np.inf if self.levant else p['epsilon']  # no gates
        scalars[arrays.GAMMA_INITIAL] = p['gamma_initial']
        scalars[arrays.RATE] = p['gamma_rate']
        scalars[arrays.MIN] = p['gamma_min']
        scalars[arrays.MAX] = p['gamma_max']
        scalars[arrays.DEAD_ZONE] = p['gamma_dead_zone']
        scalars[arrays.LEAKAGE] = p['gamma_leakage']
        scalars[arrays.DELAY] = p['gamma_leakage_delay']
        scalars[arrays.PREDICTION_STEP] = p['prediction_step']
        scalars[arrays.CORRECTION_PERIOD] = p['correction_period']
        if self.levant and p['fuzzy_growth'] and not flags[arrays.SIGN]:
            scalars[arrays.WIDEST] = max(widths)
            speed = (gains[arrays.LAMBDA, -1] / widths[-1]) ** (1.0 / levels)
            scalars[arrays.RELAXATION] = speed / 3.0
        else:
            scalars[arrays.WIDEST] = np.inf
        flags[arrays.SCHEDULED] = (
            p['noise_size'] > 0.0
            and p['unknown_input']
            and (p['correction_period'] > 0.0 or not flags[arrays.PREDICTING])
        )
        single = arrays.SINGLE * levels
        chances = np.zeros((single + arrays.SINGLES, levels))
        chances[single + arrays.FIRST_HAT] = self.initial_estimate
        chances[single + arrays.FIRST_TILDE] = self.initial_internal
        if flags[arrays.SCHEDULED]:
            self._schedule(arrays.Law(flags, gains, psi, scalars, chances, model))
        return arrays.Law(flags, gains, psi, scalars, chances, model)

    def _schedule(self, law: arrays.Law) -> None:
        """Write what the covariance is computed from (D 20)."""
        p, n, scalars, chances = self.parameters, self.levels, law.scalars, law.chances
        period = p['correction_period']
        uncertainty = Uncertainty(self.model, p, self.state_sizes)
        chances[arrays.part(arrays.RATES, n)] = uncertainty.rates
        chances[arrays.part(arrays.FRESH, n)] = uncertainty.fresh
        order = self.model.order
        sizes = [*self.state_sizes[1:], p['unknown_input_size']]
        chances[arrays.SINGLE * n + arrays.NEXT_SIZE, :order] = sizes
        scalars[arrays.VARIANCE] = uncertainty.variance
        scalars[arrays.INTENSITY] = uncertainty.intensity
        scalars[arrays.FASTEST] = uncertainty.fastest
        if not law.flags[arrays.PREDICTING]:
            return
        steady = uncertainty.steady(period)
        chances[arrays.part(arrays.STEADY, n)] = steady
        single = chances[arrays.SINGLE * n :]
        known = steady[0] > 0.0
        single[arrays.INVERSE_STEADY, known] = 1.0 / steady[0, known]
        tuned = tuned_corrections(law, p['noise_size'], period, self.gamma_initial)
        wanted = steady[0] / uncertainty.variance
        alike = (wanted > 0.0) & (tuned > 0.0)
        ratio = single[arrays.TUNED_OVER_KALMAN]
        ratio[:] = 1.0
        ratio[alike] = np.clip(tuned[alike] / wanted[alike], 1e-6, 1e6)
        scalars[arrays.STEADY_VARIANCE] = steady[0, 0] + uncertainty.variance


def tuned_corrections(law: arrays.Law, small: float, period: float, gamma: float) -> np.ndarray:
    """Return S_1 .. S_N of D 19 with which an innovation of the size `small` is corrected."""
    n = law.gains.shape[1]
    level = np.arange(1, n + 1)
    injections = law.gains[arrays.LAMBDA] * small ** (2.0 * gamma * (n - level) / n - 1.0)
    injections *= [arrays.psi(law, i, small)[0] for i in range(n)]
    shares = deadbeat_shares(n)
    return np.array([
        sum(shares[j, i] * period ** (j - i + 1) * injections[j] for j in range(i, n))
        for i in range(n)
    ])  # fmt: skip


def per_level(parameter: Parameter, values: list[float], count: int) -> np.ndarray:
    """Return one value a level from a list of 1 or `count` values, or raise."""
    if len(values) not in (1, count):
        raise parameter.error(values, f'1 or {count} values')
    return np.broadcast_to(np.array(values, dtype=np.float64), count).copy()
