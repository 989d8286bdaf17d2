# SPDX-License-Identifier: Apache-2.0
"""The paper reproduced: its simulations, figures and findings, and what lies beyond them."""
