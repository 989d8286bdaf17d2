# SPDX-License-Identifier: Apache-2.0
"""Settings shared by all tests."""

import signal

from hypothesis import settings
import pytest

# Same examples in every run; no deadline, because the first call of a kernel may compile it.
settings.register_profile('fixed', derandomize=True, deadline=None, database=None)
settings.load_profile('fixed')


@pytest.fixture(autouse=True)
def _signals():
    """The commands set handlers for the process that they take for their own."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in numbers]
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
