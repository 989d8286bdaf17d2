# SPDX-License-Identifier: Apache-2.0
"""
How loops over members become vector instructions.

A function that is declared `cdef VECTORISED name(..) noexcept nogil` returns nothing. For x86-64
gcc compiles it twice, once for processors with AVX2 and FMA, and the loader takes what the
processor has. Loops are over lines that are named by their struct, not by pointers to them, or the
compiler asks at each start of a loop whether what it writes may be what it reads; and they choose
between numbers by `a if a > b else b`, as fmin and fmax are calls.
"""

cdef extern from *:
    """
    #if defined(__x86_64__) && defined(__GLIBC__) && __GNUC__ >= 12 && !defined(__clang__)
    #define VECTORISED __attribute__((target_clones("arch=x86-64-v3", "default"))) void
    /* Another module's pointer to such a function has no attributes, which is no mistake. */
    #pragma GCC diagnostic ignored "-Wattributes"
    #else  /* clang refuses such a pointer; as ziglang has it, it compiles for this processor. */
    #define VECTORISED void
    #endif
    """
    ctypedef void VECTORISED
