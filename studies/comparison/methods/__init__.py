# SPDX-License-Identifier: Apache-2.0
"""The observers that are compared, by name."""

from studies.comparison.methods.kalman import ADAPTIVE, FILTERS
from studies.comparison.methods.method import Method
from studies.comparison.methods.observers import OBSERVERS

METHODS: dict[str, Method] = {m.name: m for m in (*FILTERS, *ADAPTIVE, *OBSERVERS)}
