"""A person at the controls: nothing moves unless the dead-man button is held and all is fresh."""

import math
import os
import pty
import signal
import subprocess
import termios
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from codesign_bringup.bringup import executable

from codesign_policy.task import MAX_TRANSLATION
from tests.faults.conftest import FakeArm, now, stamp_seconds

READY, HALTED = 1, 3
RUNNING, DONE, FAULT = 1, 2, 3
HOLD, FINISH = 4, 7


class FakeJoystick:
    """Publishes /joy at 50 Hz."""

    def __init__(self, node: Any) -> None:
        from sensor_msgs.msg import Joy

        self.axes, self.pressed = [0.0] * 8, set()
        self._joy = Joy
        self._publisher = node.create_publisher(Joy, "/joy", 10)
        self.plugged_in = True
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.02):
            if self.plugged_in:
                buttons = [int(k in self.pressed) for k in range(8)]
                self._publisher.publish(self._joy(axes=list(self.axes), buttons=buttons))

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture
def joystick(arm: FakeArm) -> Iterator[FakeJoystick]:
    joystick = FakeJoystick(arm.probe.node)
    yield joystick
    joystick.close()


@pytest.fixture
def ready(arm: FakeArm, graph: Any, joystick: FakeJoystick) -> FakeArm:
    """Controller and teleop as processes, both started."""
    graph.start("cartesian_controller")
    graph.start("teleop", {"keyboard": False})
    arm.enable()
    arm.start_policy()
    arm.probe.wait_for(lambda: arm.policy_state() == RUNNING, 10.0, "teleop runs")
    return arm


def actions_since(arm: FakeArm, when: float) -> list[Any]:
    return [m for t, m in arm.probe.received["/action"] if t >= when]


def test_the_arm_follows_a_held_stick_and_halts_when_it_is_let_go(
    ready: FakeArm, joystick: FakeJoystick
) -> None:
    joystick.axes[1] = 0.55  # half of the limit beyond the dead zone of 0.1
    arm, probe = ready, ready.probe
    message = "dead-man button 4 is not pressed"
    probe.wait_for(lambda: probe.latest("/policy/status").message == message, 5.0, "it waits")
    assert probe.received["/action"] == []

    joystick.pressed = {HOLD}
    arm.set_moving()
    actions = probe.wait_for(
        lambda: len(a := actions_since(arm, 0.0)) > 20 and a, 5.0, "20 actions"
    )
    sequences = [m.sequence for m in actions]
    assert sequences == list(range(1, len(actions) + 1))
    for m in actions:
        assert m.translation.x == pytest.approx(0.5 * MAX_TRANSLATION[0])
        assert (m.translation.y, m.translation.z, m.rotation.z, m.width) == (0.0, 0.0, 0.0, 0.0)
        assert m.header.frame_id == "link_base"
    stamps = np.array([stamp_seconds(m.header.stamp) for m in actions])
    assert np.median(np.diff(stamps)) == pytest.approx(0.05, abs=0.005)
    answered = np.array([stamp_seconds(m.observation_stamp) for m in actions])
    assert (stamps - answered).max() < 0.2

    for _ in range(3):  # a machine that starves the stand-in for an arm makes a fault instead
        joystick.pressed = set()
        if probe.poll(lambda: arm.controller_state() == HALTED, 3.0):
            break
        joystick.pressed = {HOLD}
        arm.set_moving()
    assert arm.controller_state() == HALTED
    assert arm.policy_state() == RUNNING


@pytest.mark.parametrize("trouble", ["unplugged", "not a number"])
def test_a_joystick_in_trouble_stops(ready: FakeArm, joystick: FakeJoystick, trouble: str) -> None:
    arm, probe = ready, ready.probe
    joystick.axes[1], joystick.pressed = 1.0, {HOLD}
    probe.wait_for(lambda: probe.received["/action"], 5.0, "actions")
    if trouble == "unplugged":
        joystick.plugged_in = False
    else:
        joystick.axes[5] = math.nan  # an axis without a use
    probe.wait_for(
        lambda: "no joystick message" in probe.latest("/policy/status").message, 3.0, "it stops"
    )
    stopped = now()
    assert not probe.poll(lambda: actions_since(arm, stopped), 0.5)
    assert arm.policy_state() == RUNNING


def test_without_a_pose_of_the_object_it_is_at_fault(
    ready: FakeArm, joystick: FakeJoystick
) -> None:
    arm, probe = ready, ready.probe
    joystick.pressed = {HOLD}
    probe.wait_for(lambda: probe.received["/action"], 5.0, "actions")
    arm.sends_pose = False
    probe.wait_for(
        lambda: (
            arm.policy_state() == FAULT
            and probe.latest("/policy/status").message == "no fresh /object_pose"
        ),
        5.0,
        "a fault that names the pose",
    )
    arm.sends_pose = True
    probe.wait_for(lambda: arm.policy_state() == RUNNING, 5.0, "it goes on")


def test_the_finish_button_ends_the_demonstration(ready: FakeArm, joystick: FakeJoystick) -> None:
    from std_srvs.srv import Trigger

    arm, probe = ready, ready.probe
    joystick.pressed = {HOLD}
    probe.wait_for(lambda: probe.received["/action"], 5.0, "actions")
    joystick.pressed = {HOLD, FINISH}
    probe.wait_for(lambda: arm.policy_state() == DONE, 3.0, "it is done")
    ended = now()
    joystick.pressed = {HOLD}
    assert not probe.poll(lambda: actions_since(arm, ended), 0.5)
    assert probe.call("/policy/stop", Trigger, Trigger.Request()).success
    arm.start_policy()
    probe.wait_for(lambda: actions_since(arm, ended), 5.0, "actions again")
    assert actions_since(arm, ended)[0].sequence == 1


def test_keys_of_a_terminal_act_and_ctrl_c_gives_it_back(arm: FakeArm, graph: Any) -> None:
    graph.start("cartesian_controller")
    ours, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)
    process = subprocess.Popen(
        [str(executable("codesign_nodes", "teleop"))], stdin=terminal, start_new_session=True
    )
    try:
        arm.start_policy()
        assert not termios.tcgetattr(terminal)[3] & termios.ICANON

        def acts() -> list[Any]:
            os.write(ours, b"r")
            return arm.probe.received["/action"]

        arm.probe.wait_for(acts, 10.0, "an action")
        action = arm.probe.latest("/action")
        assert action.translation.z == pytest.approx(0.5 * MAX_TRANSLATION[2])
        process.send_signal(signal.SIGINT)
        assert process.wait(10.0) == 0
        assert termios.tcgetattr(terminal) == before
    finally:
        process.kill()
        process.wait()
        os.close(ours)
        os.close(terminal)


def test_simulated_time_is_refused() -> None:
    command = [
        str(executable("codesign_nodes", "teleop")),
        "--ros-args",
        "-p",
        "use_sim_time:=true",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "use_sim_time is set: a person acts in real time" in done.stderr
