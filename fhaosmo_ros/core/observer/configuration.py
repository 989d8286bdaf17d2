# SPDX-License-Identifier: Apache-2.0
"""From checked parameters to what a structure is made from; here they are checked as a set."""

from collections.abc import Mapping
import math
from typing import Any

from fhaosmo_ros.core.model.phi import Expressions
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.fuzzy import curves, of_level, read_system
from fhaosmo_ros.core.observer.kalman import LinearModel, RATE, Uncertainty
from fhaosmo_ros.core.parameters.declaration import Parameter
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FIXED_GAMMA = 0.5
"""Power of the variants that do not adapt (paper eq. triangularObserver, fuzzysuper)."""
STEP = 0.1
"""Of a prediction, in parts of the time constant of the fastest motion of the model at rest."""
DERIVATIVES = 3
"""Derivatives of d that a self-tuning observer has behind it (D 26)."""


class ObserverConfiguration:
    """
    A valid set of observer parameters, and what follows from it for each level.

    Values by name are checked here unless they are `Parameters`; defaults for the rest. Raises
    ConfigurationError: an unknown name, a bad value, or values that do not fit together.
    """

    model: TriangularModel
    expressions: Expressions  # Phi_1 .. Phi_n, and the model of the unknown input behind (D 17)
    levels: int  # N
    self_tuning: bool  # it finds its gains by itself
    levant: bool  # it has Levant's structure
    adaptive: bool  # gamma adapts
    is_sign: bool  # psi is sign instead of a fuzzy curve
    predicting: bool  # it follows the model between samples
    implicit: bool  # a step uses the sample at its end
    internal: bool  # estimates are the internal states
    epsilon: float
    gamma_initial: float
    state_sizes: Floats  # (n,)
    prediction_step: float  # longest Runge-Kutta step between samples (s)
    initial_estimate: Floats  # (N,), and so is all that has no other shape
    initial_internal: Floats
    # With fixed gains only:
    lambdas: Floats
    alphas: Floats
    widths: Floats  # half-widths of psi
    decays: Floats  # of the internal states
    curves: Floats  # (N, K): psi of each level at K points of [0, half-width]
    schedule: Uncertainty | None  # what says P, where gains follow it (D 20)
    # What only levant with scheduled gains uses:
    steady: Floats  # (N, N) or (0, 0): P of the predictions once it is steady
    tuned_over_kalman: Floats  # tuned corrections of a small innovation over the Kalman filter's
    next_sizes: Floats  # of z_2 .. z_n and d, 0 behind them

    def __init__(self, parameters: Mapping[str, Any]) -> None:
        p = self.parameters = OBSERVER_PARAMETERS.complete(parameters)
        self.model = TriangularModel.of(p)
        if not p['gamma_min'] <= p['gamma_initial']:
            raise ConfigurationError(
                "parameters 'gamma_min', 'gamma_initial': expected the first at most the second, "
                f'got {p["gamma_min"]}, {p["gamma_initial"]}'
            )
        self.self_tuning = p['gains'] == 'self_tuning'
        self.schedule = None
        self.steady, n = np.zeros((0, 0)), self.model.order
        self.state_sizes = per_level(OBSERVER_PARAMETERS['state_sizes'], p['state_sizes'], n)
        decay = 0.0 if self.self_tuning else p['unknown_input_decay']
        self.prediction_step = p['prediction_step'] or usual_step(self.model, decay)
        self._check_structure()
        if self.self_tuning:
            self._complete_self_tuning()
        else:
            self._complete_fixed_gains()

    def forgotten(self, before: 'ObserverConfiguration') -> dict[str, float]:
        """Return what an observer forgets that goes on from a snapshot of one with `before`."""
        if self.self_tuning:
            same = self.expressions.source == before.expressions.source
            if same and self.prediction_step == before.prediction_step:
                return {}
            return {'flow_period': 0.0, 'unsettled': 0.0}  # members know another model (D 27)
        same = (self.schedule is None) == (before.schedule is None)
        if same and np.array_equal(self.steady, before.steady):
            return {}
        return {'settled': 1.0}  # P is of other sizes, or there is none

    def _complete_self_tuning(self) -> None:
        self.predicting = self.implicit = True
        self.levant = self.internal = self.adaptive = self.is_sign = False
        self.gamma_initial, self.epsilon = 0.0, np.inf  # no power, no gates
        self.levels = self.model.order + 1 + DERIVATIVES
        self.initial_estimate = self.initial_internal = np.zeros(self.levels)
        self.expressions = self.model.with_unknown_input(0.0, DERIVATIVES)

    def _complete_fixed_gains(self) -> None:
        p, n = self.parameters, self.model.order
        self.levant = self.predicting = p['structure'] == 'levant'
        self.implicit = self.levant or p['scheme'] == 'implicit'
        self.internal = p['estimate_from'] == 'internal'
        adaptive = p['variant'].endswith('_adaptive')
        self.adaptive = adaptive and not self.levant
        self.is_sign = p['variant'].startswith('sign')
        self.gamma_initial = p['gamma_initial'] if adaptive else FIXED_GAMMA
        self.epsilon = np.inf if self.levant else p['epsilon']  # one innovation has no gates
        self.levels = levels = n + (1 + p['unknown_input_derivatives']) * p['unknown_input']
        self.tuned_over_kalman, self.next_sizes = np.ones(levels), np.zeros(levels)
        self.initial_estimate = self._per_level('initial_estimate')
        self.initial_internal = self._per_level('initial_internal')
        if self.levant:
            self.initial_internal = np.append(self.initial_estimate[1:], 0.0)
        for name in ('fuzzy_widths', 'fuzzy_systems'):
            declared = OBSERVER_PARAMETERS[name]
            if len(p[name]) > levels and p[name] != declared.default:
                raise declared.error(p[name], f'1 to {levels} values (N = {levels} levels)')
        self.widths = np.array([of_level(p['fuzzy_widths'], i) for i in range(levels)])
        if self.is_sign:  # no curve is read
            for text in p['fuzzy_systems']:
                read_system(text)
            self.curves = np.ones((levels, 2))
        else:
            self.curves = curves(p, levels)
        self.lambdas, self.alphas = self._per_level('lambda'), self._per_level('alpha')
        self.decays = np.zeros(levels)  # D 17: of d, d', .. but not of theta
        self.decays[n - 1 : -1 if p['unknown_input'] else None] = p['unknown_input_decay']
        self.expressions = self.model.with_unknown_input(
            p['unknown_input_decay'], p['unknown_input_derivatives']
        )
        rate = p['unknown_input_decay'] or RATE
        usual = p['unknown_input_size'] / rate ** np.arange(n, 0.0, -1.0)  # d integrated
        self.state_sizes = np.where(self.state_sizes > 0.0, self.state_sizes, usual)
        starts = not self.levant or p['correction_period'] > 0.0
        if p['noise_size'] > 0.0 and p['unknown_input'] and starts:
            self.schedule = Uncertainty(self.model, p, self.state_sizes)
            if self.levant:
                self._complete_schedule(self.schedule)

    def _check_structure(self) -> None:
        p = self.parameters
        without = {'gains': 'fixed', 'structure': 'cascade', 'unknown_input_derivatives': 0}
        for name, value in without.items():
            if p[name] != value and not p['unknown_input']:
                raise ConfigurationError(
                    f"parameters '{name}', 'unknown_input': {name} = {p[name]} needs levels of "
                    'the unknown input, expected unknown_input = true, got false'
                )
        cascade = p['gains'] == 'fixed' and p['structure'] == 'cascade'
        if cascade and p['scheme'] == 'predict_correct':
            raise ConfigurationError(
                "parameters 'scheme', 'structure': expected scheme = 'explicit' or 'implicit' "
                "with cascade, got 'predict_correct'"
            )

    def _per_level(self, name: str) -> Floats:
        return per_level(OBSERVER_PARAMETERS[name], self.parameters[name], self.levels)

    def _complete_schedule(self, schedule: Uncertainty) -> None:
        p, n, small = self.parameters, self.levels, self.parameters['noise_size']
        period, shares = p['correction_period'], deadbeat_shares(n)
        self.next_sizes[: self.model.order] = [*self.state_sizes[1:], p['unknown_input_size']]
        self.steady = schedule.steady(period)
        level, grid = np.arange(1, n + 1), np.linspace(0.0, 1.0, self.curves.shape[1])
        injections = self.lambdas * small ** (2.0 * self.gamma_initial * (n - level) / n - 1.0)
        injections *= [
            np.interp(small / width, grid, curve)
            for width, curve in zip(self.widths, self.curves, strict=True)
        ]
        for i, wanted in enumerate(self.steady[0] / schedule.variance):
            # S_i of D 19, with which an innovation of the size of the noise is corrected.
            tuned = sum(shares[j, i] * period ** (j - i + 1) * injections[j] for j in range(i, n))
            if wanted > 0.0 and tuned > 0.0:
                self.tuned_over_kalman[i] = np.clip(tuned / wanted, 1e-6, 1e6)


def deadbeat_shares(count: int) -> Floats:
    """
    Return the weights of a correction that is deadbeat for a chain of integrators (D 18).

    Row j says what a chain of j + 1 integrators has to take over of a prediction error of its
    first state, as error / h^i in the i-th derivative, so that a polynomial of degree j is known
    exactly after j + 1 samples. The i-th derivative's backward difference formula is
    (-ln(1 - B))^i / h^i, B y_k = y_k - y_{k-1}, cut off after B^j; `count` rows and columns.
    """
    logarithm = np.zeros(count)  # of the power series -ln(1 - x)
    logarithm[1:] = 1.0 / np.arange(1, count)
    power = np.eye(count)[0]
    result = np.zeros((count, count))
    for i in range(count):
        result[:, i] = np.cumsum(power)
        power = np.convolve(power, logarithm)[:count]
    return result


def usual_step(model: TriangularModel, decay: float = 0.0) -> float:
    """
    Return the Runge-Kutta step (s) that follows the fastest motion of a model at rest.

    Of a d that decays it has to be stable only: how d moves is a guess.
    """
    fastest = LinearModel(model.slopes_at_rest + np.eye(model.order, k=1), 0.0).fastest
    rate = max(fastest / STEP, decay)
    return float(1.0 / rate) if rate > 0.0 else math.inf


def per_level(parameter: Parameter, values: list[float], count: int) -> Floats:
    """
    Return one value a level from a list of 1 or `count` values, or raise.

    A default is for the paper's plant; of another size, its last value serves the levels that
    follow.
    """
    if values == parameter.default:
        values = [of_level(values, i) for i in range(count)]
    if len(values) not in (1, count):
        raise parameter.error(values, f'1 or {count} values')
    return np.broadcast_to(np.array(values, dtype=np.float64), count).copy()
