# SPDX-License-Identifier: Apache-2.0
"""Settings shared by all tests."""

from hypothesis import settings

# Same examples in every run; no deadline, because the first call of a kernel may compile it.
settings.register_profile('fixed', derandomize=True, deadline=None, database=None)
settings.load_profile('fixed')
