#!/usr/bin/env bash
# Installs, into .third-party/, programs that we did not write and that fly the emulated drones in tests/third_party, and
# what is too large for everybody's environment: Ray, and ROS 2 to compare delays with. Nothing of Skyloop needs them;
# without them those tests are skipped. Needs a Python with venv, and node with npm.
set -euo pipefail
cd "$(dirname "$0")/.."

python=.third-party/pyardrone/bin/python
if ! "$python" -c 'import cv2, pyardrone' 2>/dev/null; then
  "${PYTHON:-python3}" -m venv .third-party/pyardrone
  "$python" -m pip install --quiet --disable-pip-version-check pyardrone==0.6.1 'opencv-python-headless>=4.10,<5'
fi

for package in mavsdk==4.1.0 mavproxy==1.8.75; do
  python=.third-party/${package%%==*}/bin/python
  if ! "$python" -m pip show --quiet "${package%%==*}" 2>/dev/null; then
    "${PYTHON:-python3}" -m venv ".third-party/${package%%==*}"
    "$python" -m pip install --quiet --disable-pip-version-check "$package" setuptools
  fi
done

python=.third-party/djitellopy/bin/python
if ! "$python" -c 'import djitellopy' 2>/dev/null; then
  "${PYTHON:-python3}" -m venv .third-party/djitellopy
  "$python" -m pip install --quiet --disable-pip-version-check djitellopy==2.5.0
fi

python=.third-party/ray/bin/python
if ! "$python" -c 'import ray, skyloop' 2>/dev/null; then
  "${PYTHON:-python3}" -m venv .third-party/ray
  "$python" -m pip install --quiet --disable-pip-version-check --editable '.[sim,ray]'
fi

python=.third-party/ros2/bin/python
if ! "$python" -c 'import rclpy, skyloop' 2>/dev/null; then
  "${PYTHON:-python3}" -m venv .third-party/ros2
  "$python" -m pip install --quiet --disable-pip-version-check ros-rclpy ros-rmw-fastrtps-cpp ros-sensor-msgs
  "$python" -m pip install --quiet --disable-pip-version-check --editable .
fi

if [[ ! -e .third-party/node_modules/ar-drone/package.json ]]; then
  npm install --silent --no-audit --no-fund --prefix .third-party ar-drone@0.3.3
fi
