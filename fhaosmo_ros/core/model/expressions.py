# SPDX-License-Identifier: Apache-2.0
"""
Expressions from outside, parsed into bytecode by a whitelist.

Python's own parser reads the text (as syntax only); every node that is not on the list is refused.
Nothing is evaluated by Python, so an expression can't run anything.
"""

import ast
from collections.abc import Sequence
import math
from typing import NamedTuple
import warnings

from fhaosmo_ros.core.model import bytecode
from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

MAX_LENGTH = 500
MAX_NESTING = 50
MAX_OPERATIONS = 100
"""
Operators and functions of one expression.

An operator takes some 15 ns, a function up to 100 ns, and with its default step the plant
evaluates every Phi 40,000 times in a simulated second.
"""
MAX_FUNCTIONS = 30
"""Functions of one expression."""

FUNCTIONS = {
    'sin': bytecode.SIN,
    'cos': bytecode.COS,
    'tan': bytecode.TAN,
    'exp': bytecode.EXP,
    'log': bytecode.LOG,
    'sqrt': bytecode.SQRT,
    'abs': bytecode.ABS,
    'tanh': bytecode.TANH,
    'sign': bytecode.SIGN,
}
OPERATORS: dict[type[ast.operator], int] = {
    ast.Add: bytecode.ADD,
    ast.Sub: bytecode.SUB,
    ast.Mult: bytecode.MUL,
    ast.Div: bytecode.DIV,
    ast.Pow: bytecode.POW,
}


class Instruction(NamedTuple):
    """One operation, in postfix order."""

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
        In postfix order; empty for an expression that is the constant 0.

    Raises
    ------
    ConfigurationError
        Anything that is not on the whitelist, or more work than the limits above allow.

    """
    if len(text) > MAX_LENGTH:
        raise _error(level, text[:40] + '...', f'{len(text)} characters, at most {MAX_LENGTH}')
    if not text.isascii():  # Python would read some letters as the ones that they look like
        raise _error(level, text, 'only ASCII characters can be used')
    try:
        with warnings.catch_warnings():  # Python warns of what is refused below
            warnings.simplefilter('ignore')
            body = ast.parse(text.strip(), mode='eval').body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise _error(level, text, 'this is not an arithmetic expression') from None
    parser = _Parser(text, level)
    parser.check_work(body)
    instructions = parser.emit(body, 0)
    return [] if instructions == [Instruction(bytecode.CONST, 0.0)] else instructions


class _Parser:
    def __init__(self, text: str, level: int) -> None:
        self.text = text
        self.level = level
        self.names = {f'z{j + 1}': Instruction(bytecode.STATE, j) for j in range(level)}
        self.names['u'] = Instruction(bytecode.INPUT)

    def check_work(self, body: ast.expr) -> None:
        """Refuse an expression that would take long at every evaluation."""
        kinds = [type(node) for node in ast.walk(body)]
        functions = kinds.count(ast.Call)
        operations = functions + kinds.count(ast.BinOp) + kinds.count(ast.UnaryOp)
        for count, limit, what in (
            (functions, MAX_FUNCTIONS, 'functions'),
            (operations, MAX_OPERATIONS, 'operations'),
        ):
            if count > limit:
                raise self.error(f'{count} {what}, at most {limit}')

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
                return self.fold([*inner, Instruction(bytecode.NEG)])
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
        return Instruction(bytecode.CONST, value)

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
        if any(i.code != bytecode.CONST for i in instructions[:-1]):
            return instructions
        stack = np.zeros((2, len(instructions)))
        value, _ = bytecode.evaluate(assembled([instructions]), 0, np.zeros((2, 1)), 0.0, stack)
        if not math.isfinite(value):
            raise self.error('a constant part of it is not a finite number')
        return [Instruction(bytecode.CONST, float(value))]

    def error(self, reason: str) -> ConfigurationError:
        return _error(self.level, self.text, reason)


def _error(level: int, text: str, reason: str) -> ConfigurationError:
    names = 'z1' if level == 1 else f'z1..z{level}'
    return ConfigurationError(
        f"parameter 'phi': Phi_{level} = {text!r}: {reason}; allowed are {names}, u, numbers, "
        f'+ - * / ** and {" ".join(FUNCTIONS)}'
    )


def assembled(expressions: Sequence[Sequence[Instruction]]) -> bytecode.Bytecode:
    """Return several expressions as bytecode, one behind the other."""
    instructions = [instruction for expression in expressions for instruction in expression]
    code = np.array(instructions, dtype=np.float64).reshape(-1, 2)
    offsets = np.cumsum([0, *map(len, expressions)], dtype=np.int64)
    return bytecode.Bytecode(code, offsets)
