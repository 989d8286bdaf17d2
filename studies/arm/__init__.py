# SPDX-License-Identifier: Apache-2.0
"""External torques of simulated arms: ours beside the observers that others use."""
