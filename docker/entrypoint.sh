#!/usr/bin/env bash
# Runs a command with ROS 2 and this project on the path.
# No `set -u`: ROS's own scripts read variables that are not set. `--` keeps the command's
# arguments from the scripts sourced here, which would take them for theirs.
set -eo pipefail
. /opt/ros/jazzy/setup.bash --
. "$(dirname "${BASH_SOURCE[0]}")/../scripts/env.sh" --
exec "$@"
