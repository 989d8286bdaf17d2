# SPDX-License-Identifier: Apache-2.0
"""Time and data as they really come: stamps, gaps, outliers, memory, batches."""
