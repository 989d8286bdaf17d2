# SPDX-License-Identifier: Apache-2.0
"""The self-tuning observer: members side by side, weighted by how well they predict y."""
