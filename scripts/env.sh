# Source this (bash): puts the graph and the `codesign` command on the path of this shell.
#   . scripts/env.sh
_root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
if [ ! -f "$_root/ros_ws/install/setup.bash" ] || [ ! -x "$_root/.venv/bin/codesign" ]; then
  echo "scripts/env.sh: not set up yet, run: make setup" >&2
  unset _root
  return 1
fi
. "$_root/.venv/bin/activate"
# The wheels are an ament prefix of their own; a sourced ROS brings its own.
[ "$(cat "$_root/.venv/.ros")" = sourced ] || export AMENT_PREFIX_PATH="$_root/.venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
. "$_root/ros_ws/install/setup.bash"
for _package in codesign_nodes codesign_bringup; do
  export PATH="$_root/ros_ws/install/$_package/lib/$_package:$PATH"
done
# DDS stays on this host, on a domain of its own, unless you choose otherwise beforehand.
case "${ROS_AUTOMATIC_DISCOVERY_RANGE:-}${FASTRTPS_DEFAULT_PROFILES_FILE:-}:${RMW_IMPLEMENTATION:-}" in
  : | :rmw_fastrtps*)
    export FASTRTPS_DEFAULT_PROFILES_FILE="$_root/ros_ws/src/codesign_bringup/config/fastdds.xml"
    export ROS_AUTOMATIC_DISCOVERY_RANGE=SYSTEM_DEFAULT ;; # what the profile says
  *) export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}" ;;
esac
export ROS_DOMAIN_ID="${ROS_DOMAIN_ID:-42}"
# One thread per process: the graph's processes share the cores.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
unset _root _package
