"""Node teleop: a person's joystick or keyboard in the place of the policy, 20 actions a second.

It goes by the name of the policy, so that trial_runner finds it, and reads and publishes the same.
While the dead-man button is up or an observation is missing it is silent, and the controller's
watchdog halts the arm.
"""

import sys
import time
from typing import Any

from codesign_interfaces.msg import ControlAction as ControlActionMsg
from codesign_interfaces.msg import GripperState, PolicyStatus
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Joy
from std_srvs.srv import Trigger

from codesign_nodes import messages, qos
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, run, steady_clock
from codesign_policy.keyboard import Keyboard
from codesign_policy.task import ACTION_NAMES, POLICY_PERIOD, ControlAction
from codesign_policy.teleoperation import TIMEOUT, JoyMapping, Teleoperation

NAME = "teleop"
OBSERVED = {
    "/object_pose": (PoseStamped, qos.POSE_REQUESTED),
    "/tcp_pose": (PoseStamped, qos.POSE_REQUESTED),
    "/gripper_state": (GripperState, qos.STATE),
}


class Teleop(LeanNode):
    """Publishes what a person does."""

    def __init__(self) -> None:
        super().__init__("policy")
        if self.get_parameter("use_sim_time").value:
            raise ValueError("use_sim_time is set: a person acts in real time, leave it out")
        self._observation_timeout = declare(
            self,
            "observation_timeout",
            0.2,
            "age of an observation above which nothing is sent [s]",
            low=0.02,
            high=2.0,
        )
        timeout = declare(
            self, "joy_timeout", TIMEOUT, "for how long a /joy message or a key holds [s]",
            low=0.05, high=1.0,
        )  # fmt: skip
        self._teleoperation = Teleoperation(_declared_mapping(self), timeout)
        self._state, self._message, self._sequence = PolicyStatus.IDLE, "", 0
        self._latest: dict[str, Any] = {}
        self._received: dict[str, float] = {}
        self._action_pub = self.create_publisher(ControlActionMsg, "/action", qos.ACTION_OFFERED)
        self._status_pub = self.create_publisher(PolicyStatus, "~/status", qos.STATE_OFFERED)
        for topic, (kind, profile) in OBSERVED.items():
            self.create_subscription(
                kind, topic, lambda m, topic=topic: self._observe(topic, m), profile
            )
        self.create_subscription(Joy, "/joy", self._on_joy, qos.STATE)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self._timer = self.create_timer(POLICY_PERIOD, self._on_timer, clock=steady_clock())
        self._diagnostics = Diagnostics(self, self._report)
        wanted = declare(self, "keyboard", True, "listen to the terminal, where there is one")
        self._keyboard = Keyboard(sys.stdin.fileno()) if wanted and sys.stdin.isatty() else None

    def close(self) -> None:
        """Gives the terminal back."""
        if self._keyboard is not None:
            self._keyboard.close()

    # --- input

    def _observe(self, topic: str, message: Any) -> None:
        self._latest[topic] = message
        self._received[topic] = time.monotonic()

    def _on_joy(self, message: Joy) -> None:
        try:
            self._teleoperation.on_joy(message.axes, message.buttons, time.monotonic())
        except ValueError as error:
            self.get_logger().warning(f"/joy rejected: {error}", throttle_duration_sec=1.0)

    # --- output

    def _on_timer(self) -> None:
        now = time.monotonic()
        for key in self._keyboard.read() if self._keyboard else "":
            self._teleoperation.on_key(key, now)
        if self._state == PolicyStatus.IDLE:
            return
        missing = [
            topic
            for topic in OBSERVED
            if now - self._received.get(topic, -1e9) > self._observation_timeout
        ]
        action = None if missing else self._teleoperation.action(now)
        stamp = self.get_clock().now().to_msg()
        if action is not None:
            self._publish(action, stamp)
        self._tell(missing, action is not None, stamp)

    def _publish(self, action: ControlAction, stamp: Any) -> None:
        self._sequence += 1
        seen = {topic: message.header.stamp for topic, message in self._latest.items()}
        self._action_pub.publish(
            messages.action_message(
                action,
                self._sequence,
                stamp,
                object_stamp=seen["/object_pose"],
                tcp_stamp=seen["/tcp_pose"],
                gripper_stamp=seen["/gripper_state"],
            )
        )

    def _tell(self, missing: list[str], acts: bool, stamp: Any) -> None:
        """The state: a person who waits is at no fault, a missing observation is one."""
        self._state, self._message = PolicyStatus.RUNNING, ""
        if self._teleoperation.finished:
            self._state = PolicyStatus.DONE
        elif missing:
            self._state, self._message = PolicyStatus.FAULT, f"no fresh {', '.join(missing)}"
        elif not acts:
            self._message = self._teleoperation.silence(time.monotonic())
        self._publish_status("act" if acts else "wait", stamp)

    def _publish_status(self, phase: str, stamp: Any) -> None:
        message = PolicyStatus(
            state=self._state,
            policy=NAME,
            phase=phase,
            message=self._message,
            sequence=self._sequence,
        )
        message.header.stamp = stamp
        self._status_pub.publish(message)

    # --- services

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        if self._state in (PolicyStatus.RUNNING, PolicyStatus.FAULT):
            # Asked again, because the first answer was lost; ~/stop comes before a new start.
            response.message = f"{NAME} is running already"
            return response
        self._teleoperation.reset()
        self._sequence = 0
        self._state, self._message = PolicyStatus.RUNNING, ""
        finish = self._teleoperation.mapping.finish
        response.message = f"{NAME}: button {finish} or Enter ends the demonstration"
        return response

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._state, self._message = PolicyStatus.IDLE, ""
        self._publish_status("wait", self.get_clock().now().to_msg())
        response.success = True
        return response

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        level = DiagnosticStatus.OK
        if self._state == PolicyStatus.FAULT:
            level = DiagnosticStatus.ERROR
        values = {"actions": self._sequence, "joy_rejected": self._teleoperation.rejected}
        return level, self._message or "ready", values


def _declared_mapping(node: LeanNode) -> JoyMapping:
    """The mapping as parameters: axis.dx .. axis.dw, gain.dx .. gain.dw, button.hold, ..."""
    default = JoyMapping()

    def number(name: str, value: int, what: str, low: int = -1) -> int:
        return declare(node, name, value, f"{what}; -1: none", low=low, high=63)

    def share(name: str, value: float, what: str, low: float, high: float = 1.0) -> float:
        return declare(node, name, value, what, low=low, high=high)

    named = list(zip(ACTION_NAMES, default.axes, default.gains, strict=True))
    return JoyMapping(
        axes=tuple(
            number(f"axis.{n}", axis, f"number of the axis for {n}") for n, axis, _ in named
        ),
        gains=tuple(
            share(f"gain.{n}", gain, f"of the axis for {n}; 1: up to the limit of an action", -1.0)
            for n, _, gain in named
        ),
        hold=declare(node, "button.hold", default.hold, "the dead-man button", low=0, high=63),
        close=number("button.close", default.close, "button that closes the gap"),
        open=number("button.open", default.open, "button that opens the gap"),
        finish=number("button.finish", default.finish, "button that ends the demonstration"),
        dead_zone=share(
            "dead_zone", default.dead_zone, "part of an axis that counts as zero", 0.0, 0.9
        ),
        gap_speed=share(
            "gap_speed", default.gap_speed, "of gap buttons and keys, of an action's limit", 0.01
        ),
        key_speed=share(
            "key_speed", default.key_speed, "of other keys, of an action's limit", 0.01
        ),
    )


def main() -> None:
    """Runs the node."""
    run(Teleop)
