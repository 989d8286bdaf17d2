# SPDX-License-Identifier: Apache-2.0
# ROS 2 Jazzy with this package built:
#   docker build -t fhaosmo_ros . && docker run --rm -it --net=host fhaosmo_ros
FROM ros:jazzy-ros-base

SHELL ["/bin/bash", "-o", "pipefail", "-c"]

# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends make python3-pip python3-venv \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /ws
COPY . src/fhaosmo_ros

# rosdep would install rosbags by a pip that Ubuntu refuses, and has no key for mcap.
RUN python3 -m venv --system-site-packages venv \
    && touch venv/COLCON_IGNORE \
    && venv/bin/pip install --no-cache-dir 'mcap>=1.6,<1.7' zstandard 'rosbags>=0.11.9,<0.12'

# hadolint ignore=SC1091
RUN . venv/bin/activate \
    && . /opt/ros/jazzy/setup.bash \
    && apt-get update \
    && rosdep update --rosdistro jazzy \
    && rosdep install --from-paths src --ignore-src -y \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m colcon build

COPY scripts/container_entry.sh /container_entry.sh
ENTRYPOINT ["/bin/bash", "/container_entry.sh"]
CMD ["ros2", "launch", "fhaosmo_ros", "demo.launch.py"]
