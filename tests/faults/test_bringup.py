"""Whatever ends first, nothing that was started stays behind."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
import yaml
from codesign_bringup.bringup import (
    executable,
    load_profile,
    parse_settings,
    with_options,
    without,
)


def children_of(pid: int) -> list[int]:
    """Processes started by one process, by /proc."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            found.append(int(stat.parent.name))
    return found


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.fixture
def profile(tmp_path: Path) -> str:
    """Nodes that need neither an arm nor a simulator."""
    nodes = ["finger_design", "cartesian_controller", "policy", "trial_recorder", "trial_runner"]
    path = tmp_path / "five.yaml"
    path.write_text(yaml.safe_dump({"nodes": nodes, "options": {"slow": {"policy": {"x": 1}}}}))
    return str(path)


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [str(executable("codesign_bringup", "bringup")), *arguments]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def wait_for_children(process: subprocess.Popen[str], count: int) -> list[int]:
    deadline = time.monotonic() + 20.0
    while time.monotonic() < deadline:
        found = children_of(process.pid)
        if len(found) == count:
            time.sleep(1.0)  # until they have their signal handlers
            return found
        time.sleep(0.05)
    pytest.fail(f"{count} processes were not started")


def assert_gone(pids: list[int]) -> None:
    deadline = time.monotonic() + 12.0
    while time.monotonic() < deadline and any(map(is_alive, pids)):
        time.sleep(0.05)
    assert [p for p in pids if is_alive(p)] == []


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_everything(profile: str, sign: signal.Signals) -> None:
    process = start(profile, "--quiet")
    pids = wait_for_children(process, 5)
    process.send_signal(sign)
    assert process.wait(15) == 0
    assert_gone(pids)


def test_a_dead_node_stops_the_others(profile: str) -> None:
    process = start(profile, "--quiet")
    pids = wait_for_children(process, 5)
    os.kill(pids[1], signal.SIGKILL)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 3
    assert "ended with exit code -9" in errors
    assert_gone(pids)


def test_a_killed_bringup_leaves_nothing_behind(profile: str) -> None:
    process = start(profile, "--quiet")
    pids = wait_for_children(process, 5)
    process.kill()
    process.wait(5)
    assert_gone(pids)


def test_the_exit_code_is_the_jobs(profile: str) -> None:
    process = start(profile, "--quiet", "--", "sh", "-c", "exit 7")
    assert process.wait(30) == 7


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["moon"], "profile moon: not found; there are arm_in_the_loop, real"),
        (["sim", "--set", "tetrahedra=600"], "must be node.parameter=value"),
        (["sim", "--set", "camera.rate=3"], "--set names camera: not in this profile"),
        (["sim", "--dry-run"], "--dry-run: this profile has no such option"),
        (["sim", "--without", "moon"], "--without moon: not in this profile; there are finger_des"),
    ],
)
def test_bad_arguments_name_the_value_and_the_remedy(arguments: list[str], said: str) -> None:
    process = start(*arguments)
    _, errors = process.communicate(timeout=20)
    assert process.returncode == 2
    assert said in errors


def test_settings_are_yaml() -> None:
    parsed = parse_settings(["a.x=1", "a.y=0.5", "b.name=stock", "b.list=[1, 2]"])
    assert parsed == {"a": {"x": 1, "y": 0.5}, "b": {"name": "stock", "list": [1, 2]}}


def test_options_set_the_parameters_that_the_profile_lists_for_them() -> None:
    profile = load_profile("real")
    dry = with_options(profile, ["dry_run"])
    assert all(values == {"dry_run": True} for values in dry.values())
    assert {"xarm_driver", "cartesian_controller"} <= dry.keys()
    both = with_options(profile, ["dry_run", "slow"])
    assert both["xarm_driver"].keys() == {"dry_run", "joint_velocity"}
    assert with_options(profile, []) == {}
    with pytest.raises(ValueError, match="--fast: this profile has --dry-run, --slow"):
        with_options(profile, ["fast"])


def test_nodes_can_be_left_out() -> None:
    profile = load_profile("real")
    assert "usb_camera" in profile["nodes"]
    assert "usb_camera" not in without(profile, ["usb_camera"])["nodes"]
    assert without(profile, []) == profile


def test_profiles_start_nodes_that_exist() -> None:
    for name in ("sim", "sim_camera", "real", "arm_in_the_loop", "teleop"):
        for node in load_profile(name)["nodes"]:
            assert executable("codesign_nodes", node).exists()


@pytest.mark.parametrize(
    ("node", "setting", "said"),
    [
        ("fem_simulator", "tetrahedra:=601", "601"),
        ("fem_simulator", "arm_lag:=-1.0", "arm_lag"),
        ("policy", "policy:=magic", "policy 'magic': unknown; there are scripted"),
        ("cartesian_controller", "action_timeout:=.nan", "action_timeout"),
    ],
)
def test_a_bad_parameter_is_named_and_the_node_does_not_start(
    node: str, setting: str, said: str
) -> None:
    command = [str(executable("codesign_nodes", node)), "--ros-args", "-p", setting]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert said in done.stderr
