# SPDX-License-Identifier: Apache-2.0
"""The search: what is searched, by which optimiser, and a study that processes share."""
