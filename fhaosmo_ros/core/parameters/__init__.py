# SPDX-License-Identifier: Apache-2.0
"""Every parameter once: its declaration, the tables, parameter files, parameters per channel."""
