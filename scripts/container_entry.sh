#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Source ROS and the workspace of the Dockerfile, then run what was asked for.
set -e
. /opt/ros/jazzy/setup.bash
. /ws/install/setup.bash
exec "$@"
