"""The recorder is killed, or its disk is full: control goes on, and what was recorded is saved."""

import resource
import time
from pathlib import Path
from typing import Any

import pytest

from codesign_report import BagError
from codesign_report.bag_messages import read_messages, stamp
from codesign_report.bag_recovery import recover
from codesign_report.replay import replay
from tests.faults.conftest import FakeArm

KEPT = 100_000  # bytes that still fit on the "disk"
WATCHED = ("/joint_command", "/action")


@pytest.fixture
def recorder(graph: Any, arm: FakeArm) -> Any:
    """The recorder's process beside a policy at work; the arm moves when it is recorded."""
    child = graph.start("trial_recorder")
    graph.start("cartesian_controller")
    graph.start("policy")
    return child.process


def record(arm: FakeArm, bag: Path) -> None:
    from codesign_interfaces.srv import StartRecording

    request = StartRecording.Request(uri=str(bag))
    answer = arm.probe.call("/trial_recorder/start", StartRecording, request, timeout=40.0)
    assert answer.success, answer.message
    arm.set_moving()


def assert_control_goes_on(arm: FakeArm) -> None:
    """Set-points and actions keep coming, for a second.

    A busy machine can starve the stand-in for the arm until the controller rightly calls it a
    fault; a loop that waits for the recorder commands nothing at all, however often it is tried.
    """
    for _ in range(4):
        begin = time.monotonic()
        arm.probe.poll(lambda: False, 1.0)
        came = {topic: sum(t >= begin for t, _ in arm.probe.received[topic]) for topic in WATCHED}
        if came["/joint_command"] > 50 and came["/action"] > 10 and arm.controller_state() == 2:
            return
        arm.set_moving()
    pytest.fail(f"control does not go on: {came}, controller in state {arm.controller_state()}")


def last_heard(bag: Path) -> dict[str, int]:
    """Stamp of each topic's last message [ns]."""
    messages = read_messages(bag, WATCHED)
    return {topic: stamp(messages[topic][-1]) for topic in WATCHED}


def test_a_killed_recorder(recorder: Any, arm: FakeArm, tmp_path: Path) -> None:
    record(arm, tmp_path / "bag")
    arm.probe.poll(lambda: False, 1.5)
    recorder.kill()
    recorder.wait(5.0)
    wall = time.time_ns()
    assert_control_goes_on(arm)
    with pytest.raises(BagError, match="codesign bag recover"):
        read_messages(tmp_path / "bag", WATCHED)
    assert recover(tmp_path / "bag", tmp_path / "saved") > 100
    # Half a second is written at a time; the rest is what a busy machine takes to do it.
    for topic, last in last_heard(tmp_path / "saved").items():
        assert wall - last < 1.5e9, topic
    assert replay(tmp_path / "saved").identical


def test_a_full_disk(recorder: Any, arm: FakeArm, tmp_path: Path) -> None:
    """A limit on the size of its files gives the recorder the same error in the same place."""
    from codesign_interfaces.srv import StopRecording
    from diagnostic_msgs.msg import DiagnosticArray

    arm.probe.listen("/diagnostics", DiagnosticArray, 50)
    record(arm, tmp_path / "bag")
    (file,) = (tmp_path / "bag").glob("*.mcap")
    room = file.stat().st_size + KEPT
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (room, room))

    def complaint() -> str:
        found = [
            status.message
            for _, array in arm.probe.received["/diagnostics"]
            for status in array.status
            if status.name == "/trial_recorder" and status.level == status.ERROR
        ]
        return found[-1] if found else ""

    said = arm.probe.wait_for(complaint, 30.0, "the recorder's complaint")
    assert "File too large" in said
    assert_control_goes_on(arm)
    stopped = arm.probe.call("/trial_recorder/stop", StopRecording, StopRecording.Request())
    assert not stopped.success
    assert "File too large" in stopped.message
    assert recorder.poll() is None  # it lives, and records again where there is room
    assert file.stat().st_size <= room
    assert recover(tmp_path / "bag", tmp_path / "saved") > 20
    assert last_heard(tmp_path / "saved").keys() == set(WATCHED)
