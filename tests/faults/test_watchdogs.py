"""What goes stale or makes no sense stops the arm smoothly, and never reaches it."""

import math
import signal
from typing import Any

import numpy as np
import pytest

from codesign_control import ServoConfig
from tests.faults.conftest import OBJECT, FakeArm, now, stamp_seconds

CONFIG = ServoConfig()
READY, MOVING, HALTED, FAULT = 1, 2, 3, 4
POLICY_RUNNING, POLICY_FAULT = 1, 3


@pytest.fixture
def moving(arm: FakeArm, graph: Any) -> tuple[FakeArm, dict[str, Any]]:
    """Controller and policy as processes, the arm on its way to the block."""
    children = {name: graph.start(name) for name in ("cartesian_controller", "policy")}
    arm.set_moving()
    return arm, children


def assert_smooth(commands: list[Any]) -> None:
    """Velocity and acceleration limits in what went out."""
    moments = np.array([stamp_seconds(m.valid_at) for m in commands])
    velocity = np.array([m.velocity for m in commands])
    assert np.isfinite(velocity).all()
    assert np.abs(velocity).max() <= CONFIG.joint_velocity * 1.001
    # Consecutive set-points are one period apart by design, whenever they were sent.
    steps = np.maximum(np.diff(moments), CONFIG.period)[:, None]
    assert np.abs(np.diff(velocity, axis=0) / steps).max() <= CONFIG.joint_acceleration * 1.01


def stopping_time(arm: FakeArm) -> float:
    """From the stamp of the last action to the first set-point that stands [s]."""
    last_action = stamp_seconds(arm.probe.latest("/action").header.stamp)
    still = [
        stamp_seconds(m.header.stamp)
        for _, m in arm.probe.received["/joint_command"]
        if stamp_seconds(m.header.stamp) > last_action and np.abs(m.velocity).max() < 1e-4
    ]
    assert still
    return still[0] - last_action


def test_killed_policy_ends_in_a_controlled_stop(
    moving: tuple[FakeArm, dict[str, Any]],
) -> None:
    arm, children = moving
    killed = now()
    children["policy"].process.send_signal(signal.SIGKILL)
    arm.probe.wait_for(lambda: arm.controller_state() == HALTED, 2.0, "the arm halts")
    arm.probe.wait_for(lambda: arm.speed() < 1e-4, 2.0, "the arm stands")
    assert stopping_time(arm) <= CONFIG.action_timeout + 0.3
    assert_smooth(arm.commands_since(killed - 0.5))


def test_lost_object_pose_silences_the_policy_and_halts_the_arm(
    moving: tuple[FakeArm, dict[str, Any]],
) -> None:
    arm, _ = moving
    arm.sends_pose = False
    arm.probe.wait_for(lambda: arm.policy_state() == POLICY_FAULT, 2.0, "the policy is silent")
    assert "object_pose" in arm.probe.latest("/policy/status").message
    arm.probe.wait_for(lambda: arm.controller_state() == HALTED, 2.0, "the arm halts")
    arm.probe.wait_for(lambda: arm.speed() < 1e-4, 2.0, "the arm stands")
    actions = len(arm.probe.received["/action"])
    where = np.array(arm.probe.latest("/joint_command").position)

    back = now()
    arm.sends_pose = True
    arm.probe.wait_for(lambda: arm.policy_state() == POLICY_RUNNING, 2.0, "the policy goes on")
    arm.probe.wait_for(lambda: arm.controller_state() == MOVING, 2.0, "the arm goes on")
    arm.probe.wait_for(lambda: len(arm.probe.received["/action"]) > actions + 5, 2.0, "actions")
    resumed = arm.commands_since(back)
    assert np.abs(np.array(resumed[0].position) - where).max() < 1e-3  # no jump
    assert_smooth(resumed)


def test_object_pose_that_is_not_finite_is_no_observation(
    moving: tuple[FakeArm, dict[str, Any]],
) -> None:
    arm, _ = moving
    arm.object = (math.nan, 0.0, 0.02)
    arm.probe.wait_for(
        lambda: (
            arm.policy_state() == POLICY_FAULT
            and "not finite" in arm.probe.latest("/policy/status").message
        ),
        2.0,
        "the policy is silent and says why",
    )
    arm.probe.wait_for(lambda: arm.controller_state() == HALTED, 2.0, "the arm halts")
    for _, action in arm.probe.received["/action"]:
        assert np.isfinite([action.translation.x, action.translation.y, action.width]).all()
    arm.object = OBJECT
    arm.probe.wait_for(lambda: arm.policy_state() == POLICY_RUNNING, 2.0, "the policy goes on")


def test_lost_joint_states_are_a_fault_that_is_reset_explicitly(
    moving: tuple[FakeArm, dict[str, Any]],
) -> None:
    from std_srvs.srv import Trigger

    arm, _ = moving
    began = now()
    arm.sends_states = False
    arm.probe.wait_for(lambda: arm.controller_state() == FAULT, 2.0, "a fault")
    assert_smooth(arm.commands_since(began))
    refused = arm.probe.call("/cartesian_controller/reset_fault", Trigger, Trigger.Request())
    assert not refused.success
    assert "/joint_states" in refused.message

    arm.sends_states = True
    answer = arm.probe.call("/cartesian_controller/reset_fault", Trigger, Trigger.Request())
    assert answer.success, answer.message
    arm.enable()
    arm.probe.wait_for(lambda: arm.controller_state() in (READY, MOVING), 2.0, "ready")


def test_what_is_asked_again_changes_nothing(moving: tuple[FakeArm, dict[str, Any]]) -> None:
    """As after an answer that was lost on its way."""
    from std_srvs.srv import Trigger

    arm, _ = moving
    before = arm.probe.latest("/policy/status").sequence
    assert before > 0
    arm.enable()
    arm.start_policy()
    answer = arm.probe.call("/cartesian_controller/reset_fault", Trigger, Trigger.Request())
    assert answer.success, answer.message
    arm.probe.wait_for(
        lambda: arm.probe.latest("/policy/status").sequence > before, 2.0, "the policy goes on"
    )
    sequences = [m.sequence for _, m in arm.probe.received["/action"]]
    assert sequences == sorted(set(sequences))
    assert arm.controller_state() == MOVING


def test_joint_state_that_is_not_finite_is_a_fault(
    moving: tuple[FakeArm, dict[str, Any]],
) -> None:
    arm, _ = moving
    arm.follows = False
    bad = arm.joints.copy()
    bad[3] = math.nan
    arm.joints = bad
    arm.probe.wait_for(lambda: arm.controller_state() == FAULT, 2.0, "a fault")
    assert "finite" in arm.probe.latest("/cartesian_controller/status").message
    assert_smooth(arm.commands_since(now() - 1.0))


def test_a_controllers_fault_ends_the_trial_and_is_its_message(arm: FakeArm, graph: Any) -> None:
    from codesign_interfaces.action import RunTrial
    from rclpy.action import ActionClient

    graph.start("cartesian_controller")
    graph.start("policy")
    graph.start("trial_runner", {"simulated": False})
    client = ActionClient(arm.probe.node, RunTrial, "/run_trial")
    assert client.wait_for_server(20.0)
    sent = arm.probe.run(lambda: client.send_goal_async(RunTrial.Goal(gripper="stock")))
    arm.probe.wait_for(sent.done, 10.0, "goal taken")
    result = arm.probe.run(sent.result().get_result_async)
    # Or a busy machine has starved the stand-in for the arm: a fault of the controller as well.
    arm.probe.poll(lambda: arm.policy_state() == POLICY_RUNNING or result.done(), 60.0)
    arm.follows = False
    arm.joints = np.full(7, math.nan)
    arm.probe.wait_for(result.done, 4.0, "the trial ends before anybody's patience does")
    message = result.result().result.message
    assert not result.result().result.success
    assert "cartesian_controller at fault: " in message, message


BAD_ACTIONS = {
    "NaN": {"x": math.nan},
    "infinite": {"y": -math.inf},
    "too far": {"z": 0.5},
    "turned NaN": {"turn": math.nan},
    "gap NaN": {"width": math.nan},
    "gap too much": {"width": 0.05},
    "wrong frame": {"frame": "camera"},
    "empty frame": {"frame": ""},
}


def test_bad_actions_are_counted_and_never_reach_the_arm(arm: FakeArm, graph: Any) -> None:
    from codesign_interfaces.msg import ControlAction

    graph.start("cartesian_controller")
    arm.enable()
    arm.probe.wait_for(lambda: arm.controller_state() == READY, 5.0, "ready")
    arm.probe.wait_for(lambda: arm.probe.received["/joint_command"], 5.0, "set-points")
    before = arm.probe.latest("/cartesian_controller/status").actions_rejected
    for values in BAD_ACTIONS.values():
        action = ControlAction(sequence=1, width=values.get("width", 0.0))
        action.header.frame_id = values.get("frame", "link_base")
        action.translation.x = values.get("x", 0.0)
        action.translation.y = values.get("y", 0.0)
        action.translation.z = values.get("z", 0.0)
        action.rotation.z = values.get("turn", 0.0)
        count = arm.probe.latest("/cartesian_controller/status").actions_rejected
        arm.action_pub.publish(action)
        arm.probe.wait_for(
            lambda count=count: (
                arm.probe.latest("/cartesian_controller/status").actions_rejected > count
            ),
            3.0,
            f"{values} is rejected",
        )
    status = arm.probe.latest("/cartesian_controller/status")
    assert status.actions_rejected - before == len(BAD_ACTIONS)
    assert status.actions_accepted == 0
    positions = np.array([m.position for _, m in arm.probe.received["/joint_command"]])
    assert np.ptp(positions, axis=0).max() < 1e-9
    widths = [m.width for _, m in arm.probe.received["/gripper_command"]]
    assert np.ptp(widths) < 1e-9


def test_move_to_reaches_a_pose_and_refuses_one_outside(arm: FakeArm, graph: Any) -> None:
    from codesign_interfaces.action import MoveTo
    from rclpy.action import ActionClient

    from codesign_control import Xarm7

    graph.start("cartesian_controller")
    arm.enable()
    client = ActionClient(arm.probe.node, MoveTo, "/cartesian_controller/move_to")
    assert client.wait_for_server(10.0)

    def move(x: float, z: float) -> Any:
        goal = MoveTo.Goal(width=math.nan)
        goal.pose.header.frame_id = "link_base"
        goal.pose.pose.position.x, goal.pose.pose.position.z = x, z
        goal.pose.pose.orientation.x, goal.pose.pose.orientation.w = 1.0, 0.0
        sent = arm.probe.run(lambda: client.send_goal_async(goal))
        arm.probe.wait_for(sent.done, 5.0, "goal taken")
        result = arm.probe.run(sent.result().get_result_async)
        arm.probe.wait_for(result.done, 20.0, "goal ended")
        return result.result().result

    reached = move(0.40, 0.20)
    assert reached.success, reached.message
    tcp = Xarm7().fk_tcp(np.array(arm.probe.latest("/joint_command").position))
    np.testing.assert_allclose(tcp.position, [0.40, 0.0, 0.20], atol=1e-4)
    assert_smooth([m for _, m in arm.probe.received["/joint_command"]])
    refused = move(0.40, -0.20)
    assert not refused.success
    assert "workspace" in refused.message or "limit" in refused.message
