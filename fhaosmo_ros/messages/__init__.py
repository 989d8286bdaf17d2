# SPDX-License-Identifier: Apache-2.0
"""Numbers in messages of any type: which field is meant, and where it lies in CDR; no ROS."""
