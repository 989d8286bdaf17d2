# SPDX-License-Identifier: Apache-2.0
"""Reading, writing, copying and repairing bags, without ROS."""
