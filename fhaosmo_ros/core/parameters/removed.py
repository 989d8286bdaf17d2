# SPDX-License-Identifier: Apache-2.0
"""Parameters of older versions: what stands for each of them now."""

REMOVED = {
    'fuzzy_growth': "leave it out: 'predict_correct' has it wherever 'gamma_initial' is below 0.5",
}
"""What a message says of a name that was a parameter once."""
