# SPDX-License-Identifier: Apache-2.0
"""
Where each quantity of the observer lives: a (4, N) array of levels and a (4,) array beside it.

Rows of the level array, column i - 1 for level i:

| row | symbol | unit |
|---|---|---|
| HAT | filtered estimate z_hat_i | of z_i |
| TILDE | internal state z_tilde_{i+1}; theta at the last level | of z_{i+1} |
| HAT_SENSITIVITY | p_i = d z_hat_i / d gamma | of z_i |
| TILDE_SENSITIVITY | q_i = d z_tilde_{i+1} / d gamma | of z_{i+1} |

Entries of the array beside it:

| index | symbol | unit |
|---|---|---|
| GAMMA | adaptive power gamma | 1 |
| Y | last accepted sample of y, NaN before the first | of y |
| PENDING | time that rejected samples stood for | s |
| WAIT | time that the innovations have yet to stay small before gamma leaks | s |
"""

HAT, TILDE, HAT_SENSITIVITY, TILDE_SENSITIVITY = range(4)
ROWS = 4
GAMMA, Y, PENDING, WAIT = range(4)
SCALARS = 4
