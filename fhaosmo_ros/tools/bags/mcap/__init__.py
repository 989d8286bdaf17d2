# SPDX-License-Identifier: Apache-2.0
"""The storage files of mcap bags: written, read and salvaged by chunks."""
