"""A stand-in for the arm's driver, whose faults the tests switch on."""

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from codesign_control.xarm7 import HOME

OBJECT = (0.45, 0.0, 0.02)


class FakeArm:
    """Publishes what a driver and a camera would, at 100 Hz; follows /joint_command at once."""

    def __init__(self, probe: Any) -> None:
        from codesign_interfaces.msg import (
            ControlAction,
            ControllerStatus,
            GripperCommand,
            GripperState,
            JointCommand,
            PolicyStatus,
        )
        from codesign_nodes import messages, qos
        from geometry_msgs.msg import PoseStamped
        from sensor_msgs.msg import JointState

        from codesign_design.stock import stock_fingers

        self.probe = probe
        self.sends_states = True
        self.sends_pose = True
        self.object = OBJECT
        self.joints: Any = HOME.copy()
        self.follows = True
        self.stamp = lambda: probe.node.get_clock().now().to_msg()
        self._messages = messages
        self._kinds = (JointState, GripperState, PoseStamped)
        node = probe.node
        self._joint_pub = node.create_publisher(JointState, "/joint_states", qos.STATE_OFFERED)
        self._gripper_pub = node.create_publisher(GripperState, "/gripper_state", qos.STATE_OFFERED)
        self._pose_pub = node.create_publisher(PoseStamped, "/object_pose", qos.POSE_OFFERED)
        self._design_pub = node.create_publisher(
            type(messages.design_message(stock_fingers())), "/finger_design", qos.LATCHED
        )
        self._design_pub.publish(messages.design_message(stock_fingers()))
        self.action_pub = node.create_publisher(ControlAction, "/action", qos.ACTION_OFFERED)
        for topic, kind, profile in (
            ("/joint_command", JointCommand, qos.JOINT_COMMAND_REQUESTED),
            ("/gripper_command", GripperCommand, qos.GRIPPER_COMMAND_REQUESTED),
            ("/action", ControlAction, qos.EVERY),
            ("/policy/status", PolicyStatus, qos.EVERY),
            ("/cartesian_controller/status", ControllerStatus, qos.EVERY),
        ):
            probe.listen(topic, kind, profile)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            commands = self.probe.received["/joint_command"]
            if self.follows and commands:
                self.joints = np.array(commands[-1][1].position)
            stamp = self.stamp()
            if self.sends_states:
                self.send_gripper(stamp)
                self.send_joints(stamp)
            if self.sends_pose:
                self.send_pose(stamp)

    def send_joints(self, stamp: Any) -> None:
        joints = self._kinds[0](name=[f"joint{k}" for k in range(1, 8)])
        joints.position = [float(q) for q in self.joints]
        joints.header.stamp = stamp
        self._joint_pub.publish(joints)

    def send_gripper(self, stamp: Any) -> None:
        gripper = self._kinds[1](width=0.06)
        gripper.header.stamp = stamp
        self._gripper_pub.publish(gripper)

    def send_pose(self, stamp: Any) -> None:
        pose = self._kinds[2](pose=self._messages.pose(self.object, (0.0, 0.0, 0.0, 1.0)))
        pose.header.stamp = stamp
        pose.header.frame_id = "link_base"
        self._pose_pub.publish(pose)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def disappear(self) -> None:
        """As a driver's process that ends: its publishers go, too."""
        self.close()
        for publisher in (self._joint_pub, self._gripper_pub, self._pose_pub, self._design_pub):
            self.probe.node.destroy_publisher(publisher)

    # --- shorthand for the tests

    def controller_state(self) -> int:
        statuses = self.probe.received["/cartesian_controller/status"]
        return statuses[-1][1].state if statuses else -1

    def policy_state(self) -> int:
        statuses = self.probe.received["/policy/status"]
        return statuses[-1][1].state if statuses else -1

    def speed(self) -> float:
        """Largest commanded joint speed [rad/s]."""
        commands = self.probe.received["/joint_command"]
        return float(np.abs(commands[-1][1].velocity).max()) if commands else 0.0

    def enable(self) -> None:
        from std_srvs.srv import SetBool

        request = SetBool.Request(data=True)
        answer = self.probe.call("/cartesian_controller/enable", SetBool, request)
        assert answer.success, answer.message

    def start_policy(self) -> None:
        from std_srvs.srv import Trigger

        answer = self.probe.call("/policy/start", Trigger, Trigger.Request())
        assert answer.success, answer.message

    def set_moving(self) -> None:
        """Enables, starts the policy and waits for motion.

        A busy machine can starve this stand-in until the controller rightly calls it a fault;
        then its operator resets and tries again.
        """
        from std_srvs.srv import Trigger

        for _ in range(4):
            self.enable()
            self.start_policy()
            if self.probe.poll(lambda: self.speed() > 0.03, 8.0):
                return
            self.probe.call("/cartesian_controller/reset_fault", Trigger, Trigger.Request())
        pytest.fail("the arm does not move")

    def commands_since(self, when: float) -> list[Any]:
        """Joint commands that arrived after a monotonic time."""
        return [m for t, m in self.probe.received["/joint_command"] if t >= when]


@pytest.fixture
def arm(probe: Any) -> Iterator[FakeArm]:
    """The stand-in, running."""
    arm = FakeArm(probe)
    yield arm
    arm.close()


def stamp_seconds(stamp: Any) -> float:
    """A stamp relative to nothing in particular, for differences [s]."""
    return (stamp.sec % 100_000) + stamp.nanosec * 1e-9


def now() -> float:
    return time.monotonic()
