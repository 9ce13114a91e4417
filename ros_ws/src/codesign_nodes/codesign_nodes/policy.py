"""Node policy: observations in, actions out, 20 times a second while it runs.

At real time a timer asks for actions; without fresh observations the node stays silent and the
controller's watchdog halts the arm. With use_sim_time each observation whose stamp falls on the
policy's period is answered once, so that a trial is repeatable.
"""

import time
from dataclasses import replace
from typing import Any

import numpy as np
from codesign_interfaces.msg import ControlAction as ControlActionMsg
from codesign_interfaces.msg import FingerDesign, GripperState, PolicyStatus
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from std_srvs.srv import Trigger

from codesign_design.finger_pair import FingerPair
from codesign_nodes import messages, qos
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, nanoseconds, run, steady_clock
from codesign_policy.finger_plan import plan_for
from codesign_policy.policy import Policy, Surroundings, load_policy, policy_names
from codesign_policy.scripted import GraspPlan
from codesign_policy.task import POLICY_PERIOD, Observation

PERIOD_NS = round(POLICY_PERIOD * 1e9)
DESIGN_TIMEOUT = 3.0  # s
STATE_NAMES = {
    PolicyStatus.IDLE: "idle",
    PolicyStatus.RUNNING: "running",
    PolicyStatus.DONE: "done",
    PolicyStatus.FAULT: "fault",
}


class PolicyNode(LeanNode):
    """Serves one policy of `codesign_policy`."""

    def __init__(self) -> None:
        super().__init__("policy")
        self._name = declare(self, "policy", "scripted", f"one of {', '.join(policy_names())}")
        self._table_height = declare(
            self, "table_height", 0.0, "z of the table in link_base [m]", low=-0.5, high=0.5
        )
        self._timeout = declare(
            self,
            "observation_timeout",
            0.2,
            "age of an observation above which the policy is silent [s]",
            low=0.02,
            high=2.0,
        )
        self._width = declare(
            self,
            "scripted.width",
            0.0,
            "gap to close to [m]; 0: what suits the fingers",
            low=0.0,
            high=0.084,
        )
        self._lift = declare(
            self, "scripted.lift", GraspPlan().lift, "height to lift [m]", low=0.01, high=0.3
        )
        self._lockstep = self.get_parameter("use_sim_time").value
        load_policy(self._name, Surroundings(self._table_height, 0.0, 0.0))
        self._policy: Policy | None = None
        self._state, self._message, self._sequence = PolicyStatus.IDLE, "", 0
        self._not_finite = 0
        self._answered = -1
        self._design: FingerDesign | None = None
        self._design_came: Future | None = None
        self._latest: dict[str, Any] = {}
        self._received: dict[str, float] = {}
        self._make_interfaces()
        self._diagnostics = Diagnostics(self, self._report)

    def _make_interfaces(self) -> None:
        self._action_pub = self.create_publisher(ControlActionMsg, "/action", qos.ACTION_OFFERED)
        self._status_pub = self.create_publisher(PolicyStatus, "~/status", qos.STATE_OFFERED)
        for key, kind, topic, profile in (
            ("object_pose", PoseStamped, "/object_pose", qos.POSE_REQUESTED),
            ("tcp_pose", PoseStamped, "/tcp_pose", qos.POSE_REQUESTED),
            ("gripper_state", GripperState, "/gripper_state", qos.STATE),
        ):
            self.create_subscription(kind, topic, lambda m, key=key: self._observe(key, m), profile)
        self.create_subscription(FingerDesign, "/finger_design", self._on_design, qos.LATCHED)
        # In a group of its own: waiting for the fingers must not keep them from coming.
        waiting = ReentrantCallbackGroup()
        self.create_service(Trigger, "~/start", self._on_start, callback_group=waiting)
        self.create_service(Trigger, "~/stop", self._on_stop)
        if not self._lockstep:
            self._timer = self.create_timer(POLICY_PERIOD, self._on_timer, clock=steady_clock())

    # --- observations

    def _observe(self, key: str, message: Any) -> None:
        self._latest[key] = message
        self._received[key] = time.monotonic()
        if self._lockstep:
            self._answer_if_complete()

    def _on_design(self, message: FingerDesign) -> None:
        self._design = message
        self._stop_waiting()

    def _on_timer(self) -> None:
        if self._policy is None:
            return
        missing = self._missing()
        if missing:
            self._fault(f"no fresh {', '.join(missing)}")
            return
        self._act()

    def _missing(self) -> list[str]:
        """Observations that never came or are too old, by the steady clock."""
        now = time.monotonic()
        return [
            key
            for key in ("object_pose", "tcp_pose", "gripper_state")
            if now - self._received.get(key, -np.inf) > self._timeout
        ]

    def _answer_if_complete(self) -> None:
        """Lockstep: acts once all three observations carry the same stamp of the policy's grid."""
        if self._policy is None or len(self._latest) < 3:
            return
        stamps = {nanoseconds(m.header.stamp) for m in self._latest.values()}
        now = max(stamps)
        if len(stamps) == 1 and now % PERIOD_NS == 0 and now > self._answered:
            self._answered = now
            self._act()

    # --- actions

    def _act(self) -> None:
        assert self._policy is not None
        observation = self._observation()
        if not observation.is_finite():
            self._not_finite += 1
            self._fault(f"observation is not finite: {observation}")
            return
        action = self._policy.act(observation)
        self._sequence += 1
        message = ControlActionMsg(
            observation_stamp=self._latest["object_pose"].header.stamp,
            sequence=self._sequence,
            translation=messages.vector3(action.translation),
            rotation=messages.vector3(action.rotation),
            width=action.width,
        )
        stamp = message.observation_stamp if self._lockstep else self.get_clock().now().to_msg()
        message.header.stamp = stamp
        message.header.frame_id = "link_base"
        self._action_pub.publish(message)
        self._state = PolicyStatus.DONE if self._policy.done else PolicyStatus.RUNNING
        self._message = ""
        self._publish_status(stamp)

    def _observation(self) -> Observation:
        parameters = self._design.parameters if self._design else []
        return Observation(
            tcp_position=messages.from_xyz(self._latest["tcp_pose"].pose.position),
            object_position=messages.from_xyz(self._latest["object_pose"].pose.position),
            width=self._latest["gripper_state"].width,
            design=np.array(parameters, dtype=np.float64),
        )

    def _fault(self, why: str) -> None:
        """Silent until the observations are good again."""
        self._state, self._message = PolicyStatus.FAULT, why
        self._publish_status(self.get_clock().now().to_msg())

    def _publish_status(self, stamp: Any) -> None:
        message = PolicyStatus(
            state=self._state,
            policy=self._name,
            phase=self._policy.phase if self._policy else "",
            message=self._message,
            sequence=self._sequence,
        )
        message.header.stamp = stamp
        self._status_pub.publish(message)

    # --- services

    async def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._policy is not None and not self._policy.done:
            # Asked again, because the first answer was lost; ~/stop comes before a new start.
            response.success, response.message = True, f"{self._name} is running already"
            return response
        await self._design_or_timeout()
        if self._design is None:
            response.success = False
            response.message = "no /finger_design yet: start fem_simulator or finger_design"
            return response
        try:
            fingers = messages.design_from(self._design)
            around = Surroundings(self._table_height, fingers.tip_depth, fingers.min_width)
            self._policy = load_policy(self._name, around, self._plan_for(fingers))
        except ValueError as error:
            response.success, response.message = False, str(error)
            return response
        self._sequence = 0
        self._state, self._message = PolicyStatus.RUNNING, ""
        response.success, response.message = True, f"{self._name} with fingers {fingers.name}"
        if self._lockstep:
            self._answer_if_complete()
        return response

    def _plan_for(self, fingers: FingerPair) -> GraspPlan | None:
        if self._name != "scripted":
            return None
        plan = replace(plan_for(fingers), lift=self._lift)
        return replace(plan, width=self._width) if self._width else plan

    async def _design_or_timeout(self) -> None:
        """Just after bring-up the fingers may still be on their way."""
        if self._design is not None:
            return
        self._design_came = Future()
        timer = self.create_timer(DESIGN_TIMEOUT, self._stop_waiting, clock=steady_clock())
        await self._design_came
        self.destroy_timer(timer)

    def _stop_waiting(self) -> None:
        if self._design_came is not None and not self._design_came.done():
            self._design_came.set_result(None)

    def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._policy = None
        self._state = PolicyStatus.IDLE
        self._publish_status(self.get_clock().now().to_msg())
        response.success = True
        return response

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        level = DiagnosticStatus.OK
        if self._state == PolicyStatus.FAULT:
            level = DiagnosticStatus.ERROR
        values = {
            "policy": self._name,
            "phase": self._policy.phase if self._policy else "",
            "actions": self._sequence,
            "observations_not_finite": self._not_finite,
        }
        return level, self._message or STATE_NAMES[self._state], values


def main() -> None:
    """Runs the node."""
    run(PolicyNode)
