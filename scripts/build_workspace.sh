#!/usr/bin/env bash
# Builds ros_ws/ with colcon, against the sourced ROS 2 or against the wheels in .venv/.
# The set-up calls it; call it yourself after a change to messages or to the packages' set-up.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$PWD/.venv
if [ "$(cat "$venv/.ros")" = wheels ]; then
  export AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv
fi
export PATH=$venv/bin:$PATH VIRTUAL_ENV=$venv PYTHONWARNINGS=ignore
# The percentage line is for terminals; in a log it would be thousands of lines.
if [ -t 1 ]; then status=status+; else status=status-; fi
cd ros_ws
# As a module, so that the executables are made for this environment's Python also where colcon
# itself comes from apt.
exec "$venv/bin/python" -m colcon --log-level error build --symlink-install --event-handlers console_cohesion- $status \
  --cmake-args -DPython3_EXECUTABLE="$venv/bin/python" -DBUILD_TESTING=OFF \
  -DCMAKE_C_FLAGS=-O1 -DCMAKE_CXX_FLAGS=-O1 --no-warn-unused-cli
