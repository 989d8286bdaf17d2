# SPDX-License-Identifier: Apache-2.0
"""
Triangular models (paper eq. triangular): z_i' = z_{i+1} + Phi_i(z_1..z_i, u), from texts.

Expressions come from outside. Python's own parser reads them (as syntax only), and every node that
is not on a whitelist is refused. Nothing is evaluated by Python, so an expression can't run
anything: it becomes operations of `phi.Expressions`.
"""

import ast
from collections.abc import Mapping, Sequence
import keyword
import math
import re
import sys
from typing import Any
import warnings

from fhaosmo_ros.core.model.inputs import known_inputs
import fhaosmo_ros.core.model.phi as codes
from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import CONSTANTS
import numpy as np
from numpy.typing import ArrayLike

MAX_LENGTH = 500
MAX_OPERATIONS = 100
"""
Operators and functions of one expression.

An operator takes some 15 ns, a function up to 100 ns, and with its default step the plant
evaluates every Phi 40,000 times in a simulated second.
"""
ONE, TWO = (range(1, 2), 'one argument'), (range(2, 3), 'two arguments')
MORE = range(2, MAX_LENGTH), 'two arguments or more'
"""How many arguments functions take, and how that is said."""
FUNCTIONS = dict.fromkeys(
    ('sin', 'cos', 'tan', 'exp', 'log', 'sqrt', 'abs', 'tanh', 'sign'), ONE
) | {'atan2': TWO, 'min': MORE, 'max': MORE}  # fmt: skip
NUMBERS = {'pi': math.pi}  # names of numbers
KNOWN = [*FUNCTIONS, *NUMBERS]
OPERATORS: dict[type[ast.operator], int] = {
    ast.Add: codes.ADD, ast.Sub: codes.SUB, ast.Mult: codes.MUL, ast.Div: codes.DIV,
    ast.Pow: codes.POW,
}  # fmt: skip
Operation = tuple[int, float]
"""A code of `phi`, and the index or the number that belongs to it."""
NUMBER, INPUTS, LINEAR, OTHER = range(4)
"""What an expression is: numbers alone; with known inputs; linear in the states; or not."""


class TriangularModel:
    """
    The functions Phi_1 .. Phi_n of a triangular system, from expressions.

    Parameters
    ----------
    phi : sequence of str
        One expression a state.
    order : int, optional
        Number of states n, to be checked against ``len(phi)``.
    inputs : sequence of str
        Names of the known inputs, in the order of their values.
    constants : mapping
        Numbers by name.

    Attributes
    ----------
    order : int
        Number of states n.
    expressions : Expressions
        Phi_1 .. Phi_n.
    inputs : tuple of str
        Names of the known inputs u_1 .. u_m, in the order of their values.
    used_inputs : tuple of str
        Those of them that an expression of Phi uses.
    is_linear : bool
        Every Phi is a linear function of the states, whatever the known inputs.

    Raises
    ------
    ConfigurationError
        A wrong number of expressions, or one that is not allowed.

    """

    def __init__(
        self,
        phi: Sequence[str],
        order: int | None = None,
        inputs: Sequence[str] = ('u',),
        constants: Mapping[str, float] = {},
    ) -> None:
        if order is not None and len(phi) != order:
            raise ConfigurationError(
                f"parameter 'phi': expected {order} expressions (order = {order}), "
                f'got {len(phi)}: {list(phi)!r}'
            )
        self.phi = tuple(phi)
        self.order = len(self.phi)
        _check_names(inputs, constants)
        self.inputs = tuple(inputs)
        parsed = [parse(text, i, inputs, constants) for i, text in enumerate(self.phi, 1)]
        self._parsed = [operations for operations, _ in parsed]
        used = {index for one in self._parsed for code, index in one if code == codes.INPUT}
        self.used_inputs = tuple(name for k, name in enumerate(self.inputs) if k in used)
        self.is_linear = all(kind <= LINEAR for _, kind in parsed)
        self.expressions = codes.Expressions(self._parsed, self.order, len(self.inputs))

    @classmethod
    def of(cls, parameters: Mapping[str, Any]) -> 'TriangularModel':
        """Return the model that checked parameters describe."""
        constants = {
            name.removeprefix(CONSTANTS): value
            for name, value in parameters.items()
            if name.startswith(CONSTANTS)
        }
        return cls(parameters['phi'], parameters['order'], parameters['inputs'], constants)

    def with_unknown_input(self, decay: float, derivatives: int) -> codes.Expressions:
        """
        Return the expressions with the model of the unknown input behind those of the states.

        Parameters
        ----------
        decay : float
            kappa in Phi_i = -kappa z_i of every z_i with i > n (1/s, D 17).
        derivatives : int
            k: levels n + 1 .. n + 1 + k.

        """
        levels = range(self.order + 1, self.order + 2 + derivatives)
        behind = [parse(f'-{decay!r} * z{i}', i)[0] if decay > 0.0 else [] for i in levels]
        expressions = [*self._parsed, *behind]
        return codes.Expressions(expressions, len(expressions), len(self.inputs))

    def evaluate(self, z: np.ndarray, u: ArrayLike = 0.0) -> np.ndarray:
        """Return Phi(z, u), shape (n,); u is a number or an array (m,)."""
        values, _ = self.expressions.along(z, np.zeros(self.order), known_inputs(u, self.inputs))
        return np.asarray(values)

    def jacobian(self, z: np.ndarray, u: ArrayLike = 0.0) -> np.ndarray:
        """Return the exact Jacobian dPhi_i/dz_j, shape (n, n), lower triangular."""
        inputs = known_inputs(u, self.inputs)
        columns = [self.expressions.along(z, e, inputs)[1] for e in np.eye(self.order)]
        return np.stack(columns, axis=1)

    @property
    def slopes_at_rest(self) -> np.ndarray:
        """The Jacobian at z = 0, with 0 where a slope is not finite."""
        slopes = self.jacobian(np.zeros(self.order))
        return np.asarray(np.nan_to_num(slopes, posinf=0.0, neginf=0.0))


def _check_names(inputs: Sequence[str], constants: Mapping[str, float]) -> None:
    """Raise ConfigurationError for a name that an expression could not use."""
    taken = [*inputs, *constants]
    for parameter, names in ('inputs', inputs), ('constants', constants):
        for name in names:
            problem = ''
            if not re.fullmatch('[A-Za-z][A-Za-z0-9_]*', name) or keyword.iskeyword(name):
                problem = 'expected a letter, then letters, digits and _'
            elif re.fullmatch('z[0-9]+', name) or name in KNOWN:
                problem = 'expected a name that is not yet taken'
            elif taken.count(name) > 1:
                problem = 'expected every name once'
            if problem:
                raise ConfigurationError(f"parameter '{parameter}': {problem}, got {name!r}")


def parse(
    text: str, level: int, inputs: Sequence[str] = ('u',), constants: Mapping[str, float] = {}
) -> tuple[list[Operation], int]:
    """
    Parse Phi_level, which may use z1 .. z<level>, known inputs and constants by their names.

    Return operations in postfix order, none for an expression that is the constant 0, and what it
    is, `NUMBER` .. `OTHER`. Raises ConfigurationError for anything that is not on the whitelist,
    or exceeds the limits above.
    """
    parser = _Parser(text, level, inputs, constants)
    if len(text) > MAX_LENGTH:
        parser.text = text[:40] + '...'
        raise parser.error(f'{len(text)} characters, at most {MAX_LENGTH}')
    if not text.isascii():  # Python would read some letters as the ones that they look like
        raise parser.error('only ASCII characters can be used')
    try:
        with warnings.catch_warnings():  # Python warns of what is refused below
            warnings.simplefilter('ignore')
            body = ast.parse(text.strip(), mode='eval').body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise parser.error('this is not an arithmetic expression') from None
    work = sum(isinstance(node, ast.Call | ast.BinOp | ast.UnaryOp) for node in ast.walk(body))
    if work > MAX_OPERATIONS:  # at every evaluation
        raise parser.error(f'{work} operations, at most {MAX_OPERATIONS}')
    kind = parser.emit(body)
    return ([] if parser.code == [(codes.CONST, 0.0)] else parser.code), kind


class _Parser:
    def __init__(
        self, text: str, level: int, inputs: Sequence[str], constants: Mapping[str, float]
    ) -> None:
        self.text, self.level, self.others = text, level, [*inputs, *constants]
        self.code: list[Operation] = []
        self.names: dict[str, Operation] = {f'z{j + 1}': (codes.STATE, j) for j in range(level)}
        self.names |= {name: (codes.INPUT, k) for k, name in enumerate(inputs)}
        self.names |= {name: (codes.CONST, x) for name, x in (NUMBERS | dict(constants)).items()}

    def emit(self, node: ast.expr) -> int:
        """Append the operations of a part of the expression, and return what it is."""
        match node:
            case ast.Constant(value=bool()):
                raise self.error(f'{node.value!r} is not a number')
            case ast.Constant(value=int() | float() as number):
                if number > sys.float_info.max:
                    raise self.error('a number is too large')
                self.code.append((codes.CONST, float(number)))
                return NUMBER
            case ast.Name(id=name):
                self.code.append(self.name(name))
                return {codes.CONST: NUMBER, codes.INPUT: INPUTS}.get(self.code[-1][0], LINEAR)
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.emit(operand)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return self.apply(codes.NEG, [operand])
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                return self.apply(OPERATORS[type(op)], [left, right])
            case ast.BinOp(op=ast.BitXor()):
                raise self.error("'^' is not allowed, a power is written z1**2")
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                if name not in FUNCTIONS:
                    raise self.error(f"unknown function '{name}'{suggestion(name, FUNCTIONS)}")
                counts, needed = FUNCTIONS[name]
                if len(arguments) not in counts:
                    raise self.error(f'{name} needs {needed}, got {len(arguments)}')
                return self.apply(getattr(codes, name.upper()), arguments)
            case _:
                part = ast.get_source_segment(self.text.strip(), node) or ''
                raise self.error(f'{part[:60]!r} is not allowed')

    def apply(self, code: int, operands: list[ast.expr]) -> int:
        """Append an operation; on more than two operands, on its result and the next one."""
        count, kinds = min(len(operands), 2), list[int]()
        for operand in operands:
            kinds.append(self.emit(operand))
            if len(kinds) < count:
                continue
            self.code.append((code, 0.0))
            last = self.code[-1 - count :]
            if all(kind == codes.CONST for kind, _ in last[:-1]):  # its result stands for it
                value = float(codes.Expressions([last], 0, 0).along([0.0], [0.0], [0.0])[0, 0])
                if not math.isfinite(value):
                    raise self.error('a constant part of it is not a finite number')
                self.code[-1 - count :] = [(codes.CONST, value)]
        stays = code in (codes.ADD, codes.SUB, codes.NEG) or (
            (code == codes.MUL and NUMBER in kinds) or (code == codes.DIV and kinds[1] == NUMBER)
        )
        return max(kinds) if stays or max(kinds) < LINEAR else OTHER

    def name(self, name: str) -> Operation:
        if name in self.names:
            return self.names[name]
        if name[:1] == 'z' and name[1:].isdigit() and int(name[1:]) > self.level:
            after = f'z{self.level}: the model would not be triangular'
            raise self.error(f'{name} comes after {after}')
        if name in FUNCTIONS:
            raise self.error(f'{name} needs {FUNCTIONS[name][1]}')
        hint = suggestion(name, [*self.names, *KNOWN])
        raise self.error(
            f"unknown name '{name}'{hint}; 'inputs' declares known inputs and 'constants.{name}' "
            'a constant'
        )

    def error(self, reason: str) -> ConfigurationError:
        states = 'z1' if self.level == 1 else f'z1..z{self.level}'
        names = ', '.join([states, *self.others, 'numbers'])
        return ConfigurationError(
            f"parameter 'phi': Phi_{self.level} = {self.text!r}: {reason}; allowed are {names}, "
            f'+ - * / ** and {" ".join(KNOWN)}'
        )
