# SPDX-License-Identifier: Apache-2.0
"""The estimator node: its channels, each from a topic y to topics of estimates."""
