# SPDX-License-Identifier: Apache-2.0
"""The plant's model: Phi from expressions, and the one Runge-Kutta integrator."""
