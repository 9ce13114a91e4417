"""Faults around cartesian_controller: restarts, clocks, bad starts, wrong QoS; and the dry run."""

import time
from collections.abc import Callable
from itertools import count
from typing import Any

import numpy as np
import pytest

from codesign_control import ServoConfig, Xarm7
from codesign_control.limit_check import check_log
from tests.faults.conftest import FakeArm, now

CONFIG = ServoConfig()
READY, MOVING, HALTED, FAULT = 1, 2, 3, 4
STATUS = "/cartesian_controller/status"


def action(sequence: int, **translation: float) -> Any:
    from codesign_interfaces.msg import ControlAction

    message = ControlAction(sequence=sequence)
    message.header.frame_id = "link_base"
    for axis, value in translation.items():
        setattr(message.translation, axis, value)
    return message


def stream(arm: FakeArm, count_: int, **translation: float) -> None:
    """As many actions, at the policy's rate."""
    for k in range(count_):
        arm.action_pub.publish(action(k + 1, **translation))
        time.sleep(0.05)


def start(graph: Any, probe: Any, *arguments: Any, **options: Any) -> None:
    """The controller, up and answering; a busy machine takes its time for that."""
    from std_srvs.srv import SetBool

    graph.start("cartesian_controller", *arguments, **options)
    client = probe.node.create_client(SetBool, "/cartesian_controller/enable")
    probe.wait_for(client.service_is_ready, 90.0, "the controller is up")
    probe.node.destroy_client(client)


def undisturbed(arm: FakeArm, job: Callable[[], None]) -> None:
    """Enables and does the job; anew where a busy machine starved the stand-in for the arm."""
    from std_srvs.srv import Trigger

    for _ in range(6):
        if try_to_enable(arm).success:
            job()
            if arm.controller_state() != FAULT:
                return
        arm.probe.call("/cartesian_controller/reset_fault", Trigger, Trigger.Request())
    pytest.fail("the controller is at fault again and again")


def try_to_enable(arm: FakeArm) -> Any:
    from std_srvs.srv import SetBool

    return arm.probe.call("/cartesian_controller/enable", SetBool, SetBool.Request(data=True))


def assert_no_jump(commands: list[Any]) -> None:
    """Every set-point against the one before it, one control period earlier."""
    positions = np.array([m.position for m in commands])
    times = CONFIG.period * np.arange(len(positions))
    found = check_log(times, positions, CONFIG).findings
    assert found["joint velocity"].violations == 0, found
    assert found["self distance"].violations == 0, found


def test_a_driver_that_comes_back_is_matched_and_taken_from_where_it_is(
    arm: FakeArm, graph: Any
) -> None:
    from std_srvs.srv import Trigger

    start(graph, arm.probe)
    undisturbed(arm, lambda: stream(arm, 10, x=0.002))
    arm.disappear()
    arm.probe.wait_for(lambda: arm.controller_state() == FAULT, 3.0, "a fault")
    arm.probe.received["/joint_command"].clear()

    again = FakeArm(arm.probe)
    try:
        again.joints = moved = Xarm7().home + 0.05  # somebody moved it meanwhile
        back = now()
        answer = again.probe.call(
            "/cartesian_controller/reset_fault", Trigger, Trigger.Request(), 10.0
        )
        assert answer.success, answer.message
        assert now() - back < 2.0  # matched: the reset waits for a fresh joint state
        time.sleep(0.3)
        assert not again.commands_since(back)  # nothing before it is enabled explicitly
        again.enable()
        commands = again.probe.wait_for(lambda: again.commands_since(back), 3.0, "set-points")
        np.testing.assert_allclose(commands[0].position, moved, atol=1e-12)
    finally:
        again.disappear()


def test_starts_outside_the_limits_are_refused_with_the_reason(arm: FakeArm, graph: Any) -> None:
    start(graph, arm.probe)
    home = Xarm7().home
    arm.follows = False
    for joint, value, said in (
        (1, 2.2, "joint2 2.2000 rad, limits"),
        (0, 2.0, "workspace box"),
        (3, 0.32, "mm apart, at least"),
    ):
        arm.joints = home.copy()
        arm.joints[joint] = value
        if said.startswith("mm"):
            arm.joints[5] = 1.9
        time.sleep(0.1)
        answer = try_to_enable(arm)
        assert not answer.success
        assert said in answer.message or "workspace box" in answer.message, answer.message
    assert not arm.probe.received["/joint_command"]


def test_without_a_driver_enabling_answers_with_an_error_in_time(probe: Any, graph: Any) -> None:
    from std_srvs.srv import SetBool

    start(graph, probe)
    asked = now()
    answer = probe.call(
        "/cartesian_controller/enable", SetBool, SetBool.Request(data=True), timeout=20.0
    )
    assert not answer.success
    assert "no /joint_states within 4.0 s" in answer.message
    assert now() - asked < 15.0


def test_a_publisher_with_the_wrong_qos_shows_in_the_diagnostics(probe: Any, graph: Any) -> None:
    from codesign_interfaces.msg import ControlAction
    from codesign_nodes import qos
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

    start(graph, probe)
    probe.node.create_publisher(ControlAction, "/action", qos.STATE)  # best effort
    probe.listen("/diagnostics", DiagnosticArray, 10)

    def error() -> Any:
        return [
            status
            for _, array in probe.received["/diagnostics"]
            for status in array.status
            if status.level == DiagnosticStatus.ERROR
        ]

    found = probe.wait_for(error, 20.0, "an error")
    assert "QoS mismatch on /action" in found[-1].message
    assert found[-1].name == "/cartesian_controller"


def test_status_tells_the_limit_that_is_at_work(arm: FakeArm, graph: Any) -> None:
    from codesign_interfaces.msg import ControllerStatus
    from diagnostic_msgs.msg import DiagnosticArray

    arm.probe.listen("/diagnostics", DiagnosticArray, 10)
    start(graph, arm.probe)
    at_work = ControllerStatus.LIMIT_TABLE | ControllerStatus.LIMIT_BOX

    def seen() -> bool:
        return any(message.limits & at_work for _, message in arm.probe.received[STATUS])

    def press_down() -> None:
        """From 25 cm; what a busy machine halts goes on later."""
        for _ in range(10):
            stream(arm, 40, z=-0.007)
            if seen() or arm.controller_state() == FAULT:
                return

    undisturbed(arm, press_down)
    assert seen()
    status = arm.probe.latest(STATUS)
    assert status.table_room < 0.02
    assert 0.01 <= status.self_distance < 0.2
    assert status.nearest_links
    assert not status.dry_run
    assert_no_jump([m for _, m in arm.probe.received["/joint_command"]])

    def reported() -> bool:
        for _, array in arm.probe.received["/diagnostics"]:
            for found in array.status:
                values = {v.key: v.value for v in found.values}
                if int(values.get("at_box", 0)) + int(values.get("at_table", 0)) > 0:
                    return "singularity_scale" in values
        return False

    arm.probe.wait_for(reported, 5.0, "diagnostics count the limit")


def test_dry_run_works_everything_out_and_commands_nothing(arm: FakeArm, graph: Any) -> None:
    from codesign_nodes import qos
    from geometry_msgs.msg import PoseStamped

    arm.probe.listen("/tcp_pose", PoseStamped, qos.POSE_REQUESTED)
    start(graph, arm.probe, {"dry_run": True})
    undisturbed(arm, lambda: stream(arm, 20, z=-0.005))
    arm.probe.wait_for(lambda: arm.controller_state() == HALTED, 3.0, "the watchdog works, too")
    status = arm.probe.latest(STATUS)
    assert status.dry_run
    assert status.actions_accepted > 15
    heights = [m.pose.position.z for _, m in arm.probe.received["/tcp_pose"]]
    assert heights[0] - heights[-1] > 0.06  # where the hand would be
    assert not arm.probe.received["/joint_command"]
    assert not arm.probe.received["/gripper_command"]


class SimulatedClock:
    """Stamps of a simulator: even ticks of 10 ms, whatever the wall says."""

    def __init__(self) -> None:
        self._ticks = count(100)
        self.offset = 0.0

    def __call__(self) -> Any:
        from codesign_nodes.node_tools import stamp_of

        return stamp_of(round((1000.0 + self.offset) * 1e9) + 10_000_000 * next(self._ticks))


def test_without_clock_and_policy_the_watchdog_still_fires_and_jumps_do_not_move_it(
    arm: FakeArm, graph: Any
) -> None:
    """Simulated time, nobody publishes /clock, the policy is dead; then the stamps jump."""
    clock = SimulatedClock()
    arm.stamp = clock
    start(graph, arm.probe, {"lockstep_timeout": 0.3}, lockstep=True)
    undisturbed(arm, lambda: None)
    arm.probe.wait_for(lambda: arm.controller_state() == READY, 5.0, "ready")
    arm.action_pub.publish(action(1, x=0.003))
    arm.probe.wait_for(lambda: arm.controller_state() == MOVING, 5.0, "moving")
    arm.probe.wait_for(lambda: arm.controller_state() == HALTED, 10.0, "halted")
    for jump in (50.0, -50.0):
        clock.offset += jump
        sent = len(arm.probe.received["/joint_command"])
        arm.probe.wait_for(
            lambda sent=sent: (
                len(arm.probe.received["/joint_command"]) > sent + 20
                or arm.controller_state() == FAULT
            ),
            10.0,
            "time goes on, or the jump is a fault",
        )
    positions = np.array([m.position for _, m in arm.probe.received["/joint_command"]])
    assert np.abs(np.diff(positions, axis=0)).max() <= CONFIG.joint_velocity * CONFIG.period


def test_a_reset_whose_gripper_comes_before_its_arm_is_no_fault(arm: FakeArm, graph: Any) -> None:
    """The posture of the tick before must not be what enabling holds."""
    from codesign_nodes.node_tools import stamp_of
    from std_srvs.srv import SetBool

    arm.sends_states = arm.sends_pose = arm.follows = False
    start(graph, arm.probe, lockstep=True)
    client = arm.probe.node.create_client(SetBool, "/cartesian_controller/enable")
    client.wait_for_service(10.0)
    before, reset = stamp_of(10_040_000_000), stamp_of(10_100_000_000)
    arm.joints = Xarm7().home + 0.3
    arm.send_gripper(stamp_of(10_000_000_000))
    arm.send_joints(before)
    time.sleep(0.5)
    enabled = arm.probe.run(lambda: client.call_async(SetBool.Request(data=True)))
    time.sleep(0.5)
    arm.joints = Xarm7().home
    arm.send_gripper(reset)
    time.sleep(0.5)
    assert not enabled.done()  # it waits for the arm of that tick

    def asked_again() -> bool:
        """As a simulator that waits for its commands."""
        arm.send_gripper(reset)
        arm.send_joints(reset)
        time.sleep(0.1)
        return enabled.done()

    arm.probe.wait_for(asked_again, 5.0, "enabled")
    assert enabled.result().success, enabled.result().message
    arm.send_joints(reset)
    time.sleep(0.1)
    arm.action_pub.publish(replying_to(reset, action(1)))
    command = arm.probe.wait_for(lambda: arm.probe.received["/joint_command"], 5.0, "a set-point")
    np.testing.assert_allclose(command[0][1].position, Xarm7().home, atol=1e-9)
    assert arm.probe.received["/gripper_command"]
    assert arm.controller_state() == MOVING


def replying_to(stamp: Any, message: Any) -> Any:
    """An action that answers what was observed at that moment."""
    message.tcp_stamp = message.observation_stamp = message.header.stamp = stamp
    return message
