# SPDX-License-Identifier: Apache-2.0
"""
Expressions from outside, parsed by a whitelist into tapes.

Python's own parser reads the text (as syntax only); every node that is not on the list is refused.
Nothing is evaluated by Python, so an expression can't run anything.
"""

import ast
import math
from typing import NamedTuple

from fhaosmo_ros.core import tape
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import suggestion
import numpy as np

MAX_LENGTH = 500
MAX_NESTING = 50

FUNCTIONS = {
    'sin': tape.SIN,
    'cos': tape.COS,
    'tan': tape.TAN,
    'exp': tape.EXP,
    'log': tape.LOG,
    'sqrt': tape.SQRT,
    'abs': tape.ABS,
    'tanh': tape.TANH,
    'sign': tape.SIGN,
}
OPERATORS: dict[type[ast.operator], int] = {
    ast.Add: tape.ADD,
    ast.Sub: tape.SUB,
    ast.Mult: tape.MUL,
    ast.Div: tape.DIV,
    ast.Pow: tape.POW,
}


class Instruction(NamedTuple):
    """One operation of a tape in postfix order."""

    code: int
    operand: float = 0.0


def parse(text: str, level: int) -> list[Instruction]:
    """
    Parse Phi_level.

    Parameters
    ----------
    text : str
        The expression; it may use z1 .. z<level>, u, numbers, + - * / ** and `FUNCTIONS`.
    level : int
        1-based index of Phi.

    Returns
    -------
    list of Instruction
        The tape; empty for an expression that is the constant 0.

    Raises
    ------
    ConfigurationError
        Anything that is not on the whitelist.

    """
    if len(text) > MAX_LENGTH:
        raise _error(level, text[:40] + '...', f'{len(text)} characters, at most {MAX_LENGTH}')
    if not text.isascii():  # Python would read some letters as the ones that they look like
        raise _error(level, text, 'only ASCII characters can be used')
    try:
        body = ast.parse(text.strip(), mode='eval').body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise _error(level, text, 'this is not an arithmetic expression') from None
    instructions = _Parser(text, level).emit(body, 0)
    return [] if instructions == [Instruction(tape.CONST, 0.0)] else instructions


class _Parser:
    def __init__(self, text: str, level: int) -> None:
        self.text = text
        self.level = level
        self.names = {f'z{j + 1}': Instruction(tape.STATE, j) for j in range(level)}
        self.names['u'] = Instruction(tape.INPUT)

    def emit(self, node: ast.expr, nesting: int) -> list[Instruction]:
        if nesting > MAX_NESTING:
            raise self.error(f'nested deeper than {MAX_NESTING}')
        match node:
            case ast.Constant(value=bool()):
                raise self.error(f'{node.value!r} is not a number')
            case ast.Constant(value=int() | float() as number):
                return [self.constant(number)]
            case ast.Name(id=name):
                return [self.name(name)]
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                return self.emit(operand, nesting + 1)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                inner = self.emit(operand, nesting + 1)
                return self.fold([*inner, Instruction(tape.NEG)])
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                a, b = self.emit(left, nesting + 1), self.emit(right, nesting + 1)
                return self.fold([*a, *b, Instruction(OPERATORS[type(op)])])
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]):
                if name not in FUNCTIONS:
                    raise self.error(f"unknown function '{name}'{suggestion(name, FUNCTIONS)}")
                inner = self.emit(argument, nesting + 1)
                return self.fold([*inner, Instruction(FUNCTIONS[name])])
        part = ast.get_source_segment(self.text.strip(), node) or ''
        raise self.error(f'{part[:60]!r} is not allowed')

    def constant(self, number: float) -> Instruction:
        try:
            value = float(number)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise self.error('a number is too large')
        return Instruction(tape.CONST, value)

    def name(self, name: str) -> Instruction:
        if name in self.names:
            return self.names[name]
        if name[:1] == 'z' and name[1:].isdigit() and int(name[1:]) > self.level:
            raise self.error(
                f'{name} comes after z{self.level}: the model would not be triangular'
            )
        if name in FUNCTIONS:
            raise self.error(f'{name} needs one argument')
        raise self.error(f"unknown name '{name}'{suggestion(name, [*self.names, *FUNCTIONS])}")

    def fold(self, instructions: list[Instruction]) -> list[Instruction]:
        """Replace an operation on constants by its result."""
        if any(i.code != tape.CONST for i in instructions[:-1]):
            return instructions
        stack = np.zeros((2, len(instructions)))
        value, _ = tape.evaluate(
            as_array(instructions), 0, len(instructions), np.zeros((2, 1)), 0.0, stack
        )
        if not math.isfinite(value):
            raise self.error('a constant part of it is not a finite number')
        return [Instruction(tape.CONST, float(value))]

    def error(self, reason: str) -> ConfigurationError:
        return _error(self.level, self.text, reason)


def _error(level: int, text: str, reason: str) -> ConfigurationError:
    names = 'z1' if level == 1 else f'z1..z{level}'
    return ConfigurationError(
        f"parameter 'phi': Phi_{level} = {text!r}: {reason}; allowed are {names}, u, numbers, "
        f'+ - * / ** and {" ".join(FUNCTIONS)}'
    )


def as_array(instructions: list[Instruction]) -> tape.Floats:
    """Return a tape's codes and operands, shape (T, 2)."""
    return np.array(instructions, dtype=np.float64).reshape(-1, 2)
