# SPDX-License-Identifier: Apache-2.0
"""The one error of the core."""


class ConfigurationError(ValueError):
    """
    A configuration that can't be used.

    The text is one line that names the parameter, what is allowed and what arrived, so that
    nodes and commands can show it as it is. Bad *data* never raises: it has a status.
    """
