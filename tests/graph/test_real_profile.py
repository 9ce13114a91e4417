"""The real profile with the real SDK: a fake control box for the arm, a stand-in for the camera."""

import json
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from codesign_bringup.bringup import executable

from codesign_control import Xarm7
from codesign_control.grasp_frame import start_posture
from codesign_control.gripper import GripperModel
from codesign_report.bag_messages import read_messages
from codesign_report.bag_outcome import read_outcome
from codesign_report.replay import replay
from tests.fake_box import FakeBox

PLACE = np.array([0.452, 0.003, 0.02])  # of the block [m]
CLOSED = 0.0305  # m, a gap that holds the block
DISABLED, FAULT, POLICY_FAULT = 0, 4, 3
MOTION = ("servo_j", "motion_enable", "set_mode", "set_state")


class Camera:
    """Sends the block's pose at 20 Hz; the block goes with closed fingers.

    A pose is of the moment that the tool was last heard of, however late this thread is.
    """

    def __init__(self, probe: Any) -> None:
        from codesign_interfaces.msg import GripperState
        from codesign_nodes import qos
        from geometry_msgs.msg import PoseStamped

        self._kind = PoseStamped
        self._probe = probe
        self._publisher = probe.node.create_publisher(PoseStamped, "/object_pose", qos.POSE_OFFERED)
        probe.listen("/tcp_pose", PoseStamped, qos.STATE)
        probe.listen("/gripper_state", GripperState, qos.STATE)
        self._tool: Any = None  # the newest /tcp_pose
        self._held: np.ndarray | None = None
        self.place = PLACE.copy()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        from codesign_nodes import messages

        while not self._stop.wait(0.05):
            self._follow(messages.from_xyz)
            message = self._kind(pose=messages.pose(self.place, (0.0, 0.0, 0.0, 1.0)))
            message.header.stamp = self._moment()
            message.header.frame_id = "link_base"
            self._publisher.publish(message)

    def _moment(self) -> Any:
        if self._tool is None:
            return self._probe.node.get_clock().now().to_msg()
        return self._tool.header.stamp

    def _follow(self, from_xyz: Any) -> None:
        tools, grippers = (self._probe.received[t] for t in ("/tcp_pose", "/gripper_state"))
        if not tools or not grippers:
            return
        self._tool = tools[-1][1]
        tool = from_xyz(self._tool.pose.position)
        if grippers[-1][1].width > CLOSED:
            self._held = None
        elif self._held is not None:
            self.place = tool + self._held
        elif np.linalg.norm(tool - self.place) < 0.04:
            self._held = self.place - tool

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._probe.node.destroy_publisher(self._publisher)


@pytest.fixture
def camera(probe: Any) -> Iterator[Camera]:
    camera = Camera(probe)
    yield camera
    camera.close()


def away() -> list[float]:
    """A posture beside the start posture [rad]."""
    start = start_posture(Xarm7(), GripperModel(), 0.06)
    return np.add(start, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).tolist()


@pytest.fixture
def box() -> Iterator[FakeBox]:
    with FakeBox(joints=away()) as box:
        yield box


def bringup(box: FakeBox, out: Path, *options: str, job: list[str]) -> subprocess.Popen[str]:
    command = [
        str(executable("codesign_bringup", "bringup")), "real", "--quiet",
        "--log-folder", str(out / "logs"),
        "--without", "usb_camera", "--without", "tofu_pose_estimator",
        "--set", f"xarm_driver.address={box.address}", *options, "--", *job,
    ]  # fmt: skip
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def trial(
    box: FakeBox, out: Path, *options: str, first: str = "true", timeout: float = 120.0
) -> tuple[int, str, Any]:
    """Exit code, output and result of one trial; `first`: what an operator does before."""
    tools = executable("codesign_bringup", "run_trials").parent
    job = ["sh", "-c", f"PATH={tools}:$PATH; {first} && exec run_trials --count 1 --out {out}"]
    said, _ = (process := bringup(box, out, *options, job=job)).communicate(timeout=timeout)
    path = out / "trials.json"
    result = json.loads(path.read_text())["trials"][0] if path.exists() else None
    return process.returncode, said, result


def watchdogs_barked(bag: Path) -> bool:
    """Whether a node had to halt the arm, as on a machine too busy for nodes and stand-ins."""
    topics = ("/policy/status", "/cartesian_controller/status")
    policy, controller = (read_messages(bag, topics)[topic] for topic in topics)
    halts = [message.halts for message in controller if message.state != DISABLED]
    at_fault = any(message.state == POLICY_FAULT for message in policy)
    return at_fault or max(halts) > min(halts) or any(m.state == FAULT for m in controller)


def test_a_trial_on_the_arm(probe: Any, tmp_path: Path) -> None:
    """Anew, with another box, where a watchdog halted the arm; no other failure is tried again."""
    for attempt in range(4):
        with FakeBox(joints=away()) as box, closing(Camera(probe)) as camera:
            code, said, result = trial(box, tmp_path / str(attempt), first="operate enable")
            assert not box.violations()
        if code == 0 or not watchdogs_barked(Path(result["bag"])):
            break
    assert code == 0, said
    assert result["success"], result["message"]
    assert camera.place[2] == pytest.approx(0.12, abs=0.003)
    bag = Path(result["bag"])
    outcome = read_outcome(bag)
    assert not outcome.stress_known
    assert outcome.metrics.success
    assert (
        outcome.metrics.peak_lift == result["metrics"]["peak_lift"] == pytest.approx(0.1, abs=0.003)
    )
    again = replay(bag)
    assert again.identical, again.first
    assert again.unknown == 0


def test_an_arm_that_nobody_enabled_is_named(box: FakeBox, camera: Camera, tmp_path: Path) -> None:
    code, said, result = trial(box, tmp_path)
    assert code == 1, said
    assert "is its driver enabled?" in result["message"]
    assert box.commands("servo_j") == []


def test_a_dry_run_moves_nothing(box: FakeBox, camera: Camera, probe: Any, tmp_path: Path) -> None:
    """The policy acts, the controller computes, and not one motion command is on the wire."""
    from diagnostic_msgs.msg import DiagnosticArray

    probe.listen("/diagnostics", DiagnosticArray, 100)
    before = box.switch()["joints"]
    code, said, result = trial(box, tmp_path, "--dry-run")
    assert code == 1, said  # nothing was picked up
    assert "DRY RUN" in said
    assert result["message"] == "dry run: nothing moved"
    assert box.commands(*MOTION) == []
    assert box.switch()["joints"] == before
    dry_runs = {
        status.name
        for _, array in probe.received["/diagnostics"]
        for status in array.status
        if {v.key: v.value for v in status.values}.get("dry_run") == "True"
    }
    assert dry_runs == {"/xarm_driver", "/cartesian_controller", "/trial_runner"}
    again = replay(Path(result["bag"]))
    assert again.identical
    assert again.actions > 100


@pytest.mark.timeout(600)
def test_what_an_operator_does(box: FakeBox, camera: Camera, tmp_path: Path) -> None:
    """Enable, home, emergency stop, recover, home, disable; with the commands of the guide."""

    def operate(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [str(executable("codesign_bringup", "operate")), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=90)

    def go_home(*arguments: str) -> None:
        """A machine that is too busy for the watchdogs makes the controller rightly call it a
        fault; then an operator recovers and tries again."""
        for _ in range(4):
            home = operate("home", "--speed", "0.2", *arguments)
            if home.returncode == 0:
                return
            operate("recover")
        pytest.fail(home.stderr)

    process = bringup(box, tmp_path, "--slow", job=["sleep", "600"])
    try:
        refused = operate("home")
        enabled = operate("enable")
        assert enabled.returncode == 0, enabled.stderr
        assert refused.returncode == 1  # nothing moves before somebody enables the driver
        go_home("--width", "0.06")
        goal = start_posture(Xarm7(), GripperModel(), 0.06)
        assert np.abs(np.array(box.switch()["joints"]) - goal).max() < 0.02
        box.switch(emergency_stop=2)
        for _ in range(4):  # diagnostics come once a second
            time.sleep(1.0)
            stopped = operate("status")
            if stopped.returncode:
                break
        assert stopped.returncode == 1
        assert "ERROR" in stopped.stdout
        assert operate("recover").returncode == 1  # the button is still pressed
        box.switch(emergency_stop=0)
        recovered = operate("recover")
        assert recovered.returncode == 0, recovered.stderr
        go_home()
        assert operate("disable").returncode == 0
        assert not box.violations()
    finally:
        process.terminate()
        process.communicate(timeout=30)
