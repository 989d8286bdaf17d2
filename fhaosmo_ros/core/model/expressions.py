# SPDX-License-Identifier: Apache-2.0
"""
Expressions from outside, parsed into the operations of `phi.Expressions` by a whitelist.

Python's own parser reads the text (as syntax only); every node that is not on the list is refused.
Nothing is evaluated by Python, so an expression can't run anything.
"""

import ast
from collections.abc import Mapping, Sequence
import keyword
import math
import re
import sys
import warnings

from fhaosmo_ros.core.model import phi
from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError

MAX_LENGTH = 500
MAX_OPERATIONS = 100
"""
Operators and functions of one expression.

An operator takes some 15 ns, a function up to 100 ns, and with its default step the plant
evaluates every Phi 40,000 times in a simulated second.
"""

ARGUMENTS = {
    range(1, 2): 'one argument',
    range(2, 3): 'two arguments',
    range(2, MAX_LENGTH): 'two arguments or more',
}
"""How many arguments functions take, and how that is said."""
ONE, TWO, MORE = ARGUMENTS
FUNCTIONS = dict.fromkeys(
    ('sin', 'cos', 'tan', 'exp', 'log', 'sqrt', 'abs', 'tanh', 'sign'), ONE
) | {'atan2': TWO, 'min': MORE, 'max': MORE}  # fmt: skip
NUMBERS = {'pi': math.pi}
"""Names of numbers."""
KNOWN = [*FUNCTIONS, *NUMBERS]
OPERATORS: dict[type[ast.operator], int] = {
    ast.Add: phi.ADD,
    ast.Sub: phi.SUB,
    ast.Mult: phi.MUL,
    ast.Div: phi.DIV,
    ast.Pow: phi.POW,
}
Operation = tuple[int, float]
"""A code of `phi`, and the index or the number that belongs to it."""


def check_names(inputs: Sequence[str], constants: Mapping[str, float]) -> None:
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
) -> list[Operation]:
    """
    Parse Phi_level, which may use z1 .. z<level>, known inputs and constants by their names.

    Return operations in postfix order, none for an expression that is the constant 0. Raises
    ConfigurationError for anything that is not on the whitelist, or exceeds the limits above.
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
    parser.emit(body)
    return [] if parser.code == [(phi.CONST, 0.0)] else parser.code


class _Parser:
    def __init__(
        self, text: str, level: int, inputs: Sequence[str], constants: Mapping[str, float]
    ) -> None:
        self.text, self.level, self.others = text, level, [*inputs, *constants]
        self.code: list[Operation] = []
        self.names: dict[str, Operation] = {f'z{j + 1}': (phi.STATE, j) for j in range(level)}
        self.names |= {name: (phi.INPUT, k) for k, name in enumerate(inputs)}
        self.names |= {name: (phi.CONST, x) for name, x in (NUMBERS | dict(constants)).items()}

    def emit(self, node: ast.expr) -> None:
        """Append the operations of a part of the expression."""
        match node:
            case ast.Constant(value=bool()):
                raise self.error(f'{node.value!r} is not a number')
            case ast.Constant(value=int() | float() as number):
                if number > sys.float_info.max:
                    raise self.error('a number is too large')
                self.code.append((phi.CONST, float(number)))
            case ast.Name(id=name):
                self.code.append(self.name(name))
            case ast.UnaryOp(op=ast.UAdd(), operand=operand):
                self.emit(operand)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                self.apply(phi.NEG, [operand])
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                self.apply(OPERATORS[type(op)], [left, right])
            case ast.BinOp(op=ast.BitXor()):
                raise self.error("'^' is not allowed, a power is written z1**2")
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                if name not in FUNCTIONS:
                    raise self.error(f"unknown function '{name}'{suggestion(name, FUNCTIONS)}")
                if len(arguments) not in FUNCTIONS[name]:
                    needed = ARGUMENTS[FUNCTIONS[name]]
                    raise self.error(f'{name} needs {needed}, got {len(arguments)}')
                self.apply(getattr(phi, name.upper()), arguments)
            case _:
                part = ast.get_source_segment(self.text.strip(), node) or ''
                raise self.error(f'{part[:60]!r} is not allowed')

    def apply(self, code: int, operands: list[ast.expr]) -> None:
        """Append an operation on one or two operands; on more, on its result and the next one."""
        count = min(len(operands), 2)
        for k, operand in enumerate(operands, 1):
            self.emit(operand)
            if k < count:
                continue
            self.code.append((code, 0.0))
            last = self.code[-1 - count :]
            if all(kind == phi.CONST for kind, _ in last[:-1]):  # its result stands for it
                value = float(phi.Expressions([last], 0, 0).along([0.0], [0.0], [0.0])[0, 0])
                if not math.isfinite(value):
                    raise self.error('a constant part of it is not a finite number')
                self.code[-1 - count :] = [(phi.CONST, value)]

    def name(self, name: str) -> Operation:
        if name in self.names:
            return self.names[name]
        if name[:1] == 'z' and name[1:].isdigit() and int(name[1:]) > self.level:
            raise self.error(
                f'{name} comes after z{self.level}: the model would not be triangular'
            )
        if name in FUNCTIONS:
            raise self.error(f'{name} needs {ARGUMENTS[FUNCTIONS[name]]}')
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


def is_linear(tokens: Sequence[Operation]) -> bool:
    """Return True if an expression is sums of states times numbers, and of anything else."""
    # 0: a number, 1: a number or known inputs, 2: linear in the states, 3: anything else
    stack: list[int] = []
    for code, _ in tokens:
        if code <= phi.INPUT:
            stack.append({phi.CONST: 0, phi.INPUT: 1, phi.STATE: 2}[int(code)])
        elif code <= phi.MAX:
            b, a = stack.pop(), stack.pop()
            most = max(a, b)
            is_kept = (
                code in (phi.ADD, phi.SUB)
                or (code == phi.MUL and 0 in (a, b))
                or (code == phi.DIV and b == 0)
            )
            stack.append(most if is_kept or most < 2 else 3)
        else:
            a = stack.pop()
            stack.append(a if code == phi.NEG or a < 2 else 3)
    return max(stack, default=0) < 3
