# SPDX-License-Identifier: Apache-2.0
"""
Phi_1 .. Phi_n as bytecode, and its interpreter: value and exact derivative in one pass.

Bytecode is plain data (operations in postfix order), so a model from a YAML file needs no code
generation, and nothing from outside is ever executed. The derivative along dz is carried by
forward-mode differentiation (dual numbers).
"""

from libc.math cimport (
    atan2, copysign, cos, exp, fabs, hypot, isnan, log, pow, sin, sqrt, tan, tanh
)

import numpy as np

INSTRUCTION = [('code', np.intc), ('index', np.intc), ('constant', np.float64)]


cdef inline double sign_of(double a) noexcept nogil:
    """Return -1, 0 or 1; NaN for NaN."""
    return a if a == 0.0 or isnan(a) else copysign(1.0, a)


cdef check(one, int states, int inputs):
    """Raise ValueError unless operations can be evaluated: nothing else looks at them."""
    depth = 0
    for code, x in one:
        depth += 1 if code <= INPUT else -1 if code <= MAX else 0
        most = {STATE: states, INPUT: inputs}.get(code)
        known = CONST <= code <= SIGN and 0 < depth <= MOST_OPERANDS
        if not known or not (most is None or 0 <= x < most):
            raise ValueError(f'expected operations in postfix order, got {one}')
    if one and depth != 1:
        raise ValueError(f'expected operations that leave one number, got {one}')


cdef class Expressions:
    """
    Several expressions of states and known inputs; immutable, so that threads can share it.

    `source` has each expression's operations in postfix order: `CONST` .. `SIGN`, and the
    constant, or the index of the state or input, that belongs to it. An empty expression is the
    constant 0. Raises ValueError for operations that lack operands, or need too much room.
    """

    def __cinit__(self, source, int states, int inputs):
        self.source = tuple(tuple((int(c), float(x)) for c, x in one) for one in source)
        self.count, self.states, self.inputs = len(self.source), states, inputs
        for one in self.source:
            check(one, states, inputs)
        code = [(c, 0 if c == CONST else x, x) for one in self.source for c, x in one]
        self.code = np.array([*code, (CONST, 0, 0.0)], dtype=INSTRUCTION)  # never empty
        self.offsets = np.cumsum([0, *map(len, self.source)], dtype=np.intc)

    def __reduce__(self):
        return Expressions, (self.source, self.states, self.inputs)

    cdef Dual evaluate(
        self, int i, const double* z, const double* dz, const double* u
    ) noexcept nogil:
        """
        Return Phi_{i+1}(z, u) and its derivative along dz, for an expression that is not empty.

        Outside its domain an operation gives NaN or infinity.
        """
        cdef Dual stack[MOST_OPERANDS]
        cdef const Instruction* instruction = &self.code[self.offsets[i]]
        cdef const Instruction* end = &self.code[self.offsets[i + 1]]
        cdef Dual* top = stack - 1
        cdef int code
        cdef double a, da, b, db, v, d
        while instruction != end:
            code = instruction.code
            if code <= INPUT:
                top += 1
                if code == CONST:
                    top.value, top.slope = instruction.constant, 0.0
                elif code == STATE:
                    top.value, top.slope = z[instruction.index], dz[instruction.index]
                else:
                    top.value, top.slope = u[instruction.index], 0.0
            elif code <= MAX:
                b, db = top.value, top.slope
                top -= 1
                a, da = top.value, top.slope
                if code == ADD:
                    top.value, top.slope = a + b, da + db
                elif code == SUB:
                    top.value, top.slope = a - b, da - db
                elif code == MUL:
                    top.value, top.slope = a * b, da * b + a * db
                elif code == DIV:
                    v = a / b
                    top.value, top.slope = v, (da - v * db) / b
                elif code == POW:
                    v, d = pow(a, b), 0.0
                    if da != 0.0 and b != 0.0:
                        d += b * pow(a, b - 1.0) * da
                    if db != 0.0 and v != 0.0:
                        d += v * log(a) * db
                    top.value, top.slope = v, d
                elif code == ATAN2:
                    v, d = hypot(a, b), 0.0  # a is sin, b is cos of the angle, times v
                    if da != 0.0 or db != 0.0:
                        d = (b / v * da - a / v * db) / v
                    top.value, top.slope = atan2(a, b), d
                elif a == b:  # the middle of the subdifferential, as for abs
                    top.slope = 0.5 * (da + db)
                elif isnan(b) or (b < a if code == MIN else b > a):  # else a stays, NaN too
                    top.value, top.slope = b, db
            else:
                a, da = top.value, top.slope
                if code == NEG:
                    top.value, top.slope = -a, -da
                elif code == SIN:
                    top.value, top.slope = sin(a), cos(a) * da
                elif code == COS:
                    top.value, top.slope = cos(a), -sin(a) * da
                elif code == TAN:
                    v = tan(a)
                    top.value, top.slope = v, (1.0 + v * v) * da
                elif code == EXP:
                    v = exp(a)
                    top.value, top.slope = v, v * da
                elif code == LOG:
                    top.value, top.slope = log(a), da / a if da != 0.0 else 0.0
                elif code == SQRT:
                    v = sqrt(a)
                    top.value, top.slope = v, 0.5 * da / v if da != 0.0 else 0.0
                elif code == ABS:
                    top.value, top.slope = fabs(a), sign_of(a) * da
                elif code == TANH:
                    v = tanh(a)
                    top.value, top.slope = v, (1.0 - v * v) * da
                else:
                    top.value, top.slope = sign_of(a), 0.0
            instruction += 1
        return stack[0]

    def along(self, z, dz, u):
        """
        Return values of all expressions, and their derivatives along dz: (2, count).

        `z` and `dz` are (n,) arrays, `u` is (m,). Raises ValueError if one is too short.
        """
        cdef const double[::1] states = np.ascontiguousarray(z, dtype=np.float64)
        cdef const double[::1] tangent = np.ascontiguousarray(dz, dtype=np.float64)
        cdef const double[::1] inputs = np.ascontiguousarray(u, dtype=np.float64)
        cdef double[:, ::1] found = np.empty((2, self.count))
        cdef Dual phi
        cdef int i
        if min(states.shape[0], tangent.shape[0]) < self.states or inputs.shape[0] < self.inputs:
            raise ValueError(f'expected {self.states} states and {self.inputs} inputs')
        for i in range(self.count):
            phi = evaluate(self, i, &states[0], &tangent[0], &inputs[0])
            found[0, i], found[1, i] = phi.value, phi.slope
        return np.asarray(found)
