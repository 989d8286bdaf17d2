# SPDX-License-Identifier: Apache-2.0
"""Phi_1 .. Phi_n as bytecode, and its interpreter: value and exact derivative in one pass."""

cpdef enum:
    CONST, STATE, INPUT
    ADD, SUB, MUL, DIV, POW, ATAN2, MIN, MAX
    NEG, SIN, COS, TAN, EXP, LOG, SQRT, ABS, TANH, SIGN

cdef enum:
    MOST_OPERANDS = 128  # on the stack of an expression; above `MAX_OPERATIONS` of triangular.py


cdef struct Dual:
    double value
    double slope  # its derivative in some direction


cdef struct Instruction:
    int code  # CONST .. SIGN
    int index  # of the state or the input
    double constant


cdef class Expressions:
    cdef readonly int count, states, inputs  # expressions; states and inputs that they may use
    cdef readonly object source  # what it was made from
    cdef const Instruction[::1] code  # of all expressions, one behind the other
    cdef const int[::1] offsets  # expression i is code[offsets[i]] .. code[offsets[i + 1] - 1]
    cdef Dual evaluate(
        self, int i, const double* z, const double* dz, const double* u
    ) noexcept nogil


cdef inline Dual evaluate(
    Expressions phi, int i, const double* z, const double* dz, const double* u
) noexcept nogil:
    """Return Phi_{i+1}(z, u) and its derivative along dz; most of a chain's are 0."""
    if phi.offsets[i] == phi.offsets[i + 1]:
        return Dual(0.0, 0.0)
    return phi.evaluate(i, z, dz, u)
