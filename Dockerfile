# humansim_ros in a container (docs/containers.md).
#
#     docker build -t humansim_ros .                                     Debian, ROS 2 from PyPI
#     docker build -t humansim_ros:jazzy --target jazzy .                on ros:jazzy, built with colcon
#     docker run --rm --shm-size 1g -v "$PWD/demo:/data/demo" humansim_ros humansim demo
#
# Both have the commands `humansim …`, run as a user without rights, in the folder /data.
ARG DEBIAN=debian:trixie-slim
ARG ROS=ros:jazzy-ros-base

# --- on a ROS 2 installation: ros2 run, ros2 launch, ros2 bag
FROM ${ROS} AS jazzy
SHELL ["/bin/bash", "-c"]
COPY . /ws/src/humansim_ros
WORKDIR /ws
RUN apt-get update && rosdep update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri python3-pip \
    && rosdep install --from-paths src -y \
    && rm -rf /var/lib/apt/lists/* \
    && pip install --no-cache-dir --break-system-packages -r src/humansim_ros/requirements-colcon.txt
RUN source /opt/ros/jazzy/setup.bash && colcon build && rm -rf build log
RUN useradd --create-home humansim && install -d -o humansim /data
USER humansim
WORKDIR /data
COPY containers/ros_entrypoint.sh /ros_entrypoint.sh
ENTRYPOINT ["/ros_entrypoint.sh"]
CMD ["ros2", "launch", "humansim_ros", "demo.launch.py"]

# --- on plain Debian: ROS 2 from PyPI
FROM ${DEBIAN} AS debian
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 libgl1-mesa-dri python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
COPY . /opt/humansim_ros
RUN python3 -m venv /opt/venv \
    && /opt/venv/bin/pip install --no-cache-dir -c /opt/humansim_ros/constraints.txt \
        "/opt/humansim_ros[ros,view,export,photographs]"
ENV PATH=/opt/venv/bin:$PATH
RUN useradd --create-home humansim && install -d -o humansim /data
USER humansim
WORKDIR /data
CMD ["humansim", "run"]
