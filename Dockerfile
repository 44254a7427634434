# The package on an installed ROS 2, with nothing from pip:
#   docker build -t gyro_calibration .                                      # Lyrical
#   docker build -t gyro_calibration --build-arg DISTRIBUTION=jazzy .
#   docker run --rm -it --network host --device /dev/ttyUSB0 gyro_calibration \
#       ros2 launch gyro_calibration gyro.launch.py port:=/dev/ttyUSB0 protocol:=auto
ARG DISTRIBUTION=lyrical
FROM ros:${DISTRIBUTION}-ros-base
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /workspace
COPY . src/gyro_calibration
RUN apt-get update \
    && rosdep update --include-eol-distros --rosdistro "$ROS_DISTRO" \
    && rosdep install --from-paths src --ignore-src --default-yes \
    && rm -rf /var/lib/apt/lists/*
RUN . "/opt/ros/$ROS_DISTRO/setup.bash" && colcon build --packages-select gyro_calibration
# the entry point of the base image sets up ROS 2 only
RUN sed -i 's#^exec #source /workspace/install/setup.bash --\nexec #' /ros_entrypoint.sh
CMD ["gyro_calibration", "--help"]
