"""Node policy: observations in, actions out, 20 times a second while it runs.

A trained pair has two stages. `~/prepare` is the design stage: it orders the pair's fingers from
finger_design, unless a person has to mount them, and waits until they are in use. `~/start` begins
the control stage. The parameter `policy` may be changed while nothing runs.

At real time a timer asks for actions; without fresh observations the node stays silent and the
controller's watchdog halts the arm. With use_sim_time each observation whose stamp falls on the
policy's period is answered once, so that a trial is repeatable: the node waits for the object's
pose of that moment. Where a camera finds none, the last one counts until it is too old; then the
node says that it is at fault, and the controller goes on without an action.
"""

import time
from dataclasses import replace
from typing import Any

import numpy as np
from codesign_interfaces.msg import ControlAction as ControlActionMsg
from codesign_interfaces.msg import FingerDesign, GripperState, PolicyStatus
from codesign_interfaces.msg import PolicySetup as PolicySetupMsg
from codesign_interfaces.srv import GenerateDesign, PreparePolicy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from codesign_design.finger_pair import FingerPair
from codesign_nodes import messages, qos
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, nanoseconds, run, steady_clock
from codesign_policy.finger_plan import plan_for
from codesign_policy.learned import mismatch
from codesign_policy.policy import (
    SCRIPTED,
    Policy,
    PolicySetup,
    Surroundings,
    policy_label,
    policy_names,
    trained_pair,
)
from codesign_policy.policy_file import TrainedPair
from codesign_policy.scripted import GraspPlan
from codesign_policy.task import POLICY_PERIOD, Observation

PERIOD_NS = round(POLICY_PERIOD * 1e9)
NEVER = -(10**18)  # ns, before any stamp
DESIGN_TIMEOUT = 3.0  # s
ORDER_PATIENCE = 10.0  # s, until an order is given again: a reply may be lost
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
        declare(
            self,
            "policy",
            SCRIPTED,
            f"one of {', '.join(policy_names())}, or the path of a checkpoint",
            read_only=False,
        )
        self._orders = declare(
            self,
            "orders_fingers",
            True,
            "~/prepare has a trained pair's fingers made; false where a person mounts them",
        )
        self._order_timeout = declare(
            self,
            "order_timeout",
            120.0,
            "longest wait of ~/prepare for fingers [s]",
            low=1.0,
            high=3600.0,
        )
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
        self._patience = declare(
            self,
            "object_patience",
            5.0,
            "lockstep: wall time that an object pose may take before it counts as missing [s]",
            low=0.1,
            high=60.0,
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
        self._pace = declare(
            self, "scripted.pace", 1.0, "share of the usual speed", low=0.1, high=1.0
        )
        self._lockstep = self.get_parameter("use_sim_time").value
        trained_pair(self._name)  # an unknown name ends the node here
        self._policy: Policy | None = None
        self._setup = PolicySetupMsg()
        self._design_parameters = np.zeros(0)
        self._state, self._message, self._sequence = PolicyStatus.IDLE, "", 0
        self._not_finite = 0
        self._answered = -1
        self._rejected = -1  # stamp of the newest picture without the object [ns]
        self._waiting: tuple[int, float] | None = None  # for the object: stamp [ns], since when [s]
        self._design: FingerDesign | None = None
        self._decoded: FingerPair | None = None
        self._design_came: Future | None = None
        self._latest: dict[str, Any] = {}
        self._received: dict[str, float] = {}
        self._make_interfaces()
        self._diagnostics = Diagnostics(self, self._report)

    def _make_interfaces(self) -> None:
        self._action_pub = self.create_publisher(ControlActionMsg, "/action", qos.ACTION_OFFERED)
        self._status_pub = self.create_publisher(PolicyStatus, "~/status", qos.STATE_OFFERED)
        self._setup_pub = self.create_publisher(PolicySetupMsg, "~/setup", qos.LATCHED)
        for key, kind, topic, profile in (
            ("object_pose", PoseStamped, "/object_pose", qos.POSE_REQUESTED),
            ("tcp_pose", PoseStamped, "/tcp_pose", qos.POSE_REQUESTED),
            ("gripper_state", GripperState, "/gripper_state", qos.STATE),
        ):
            self.create_subscription(kind, topic, lambda m, key=key: self._observe(key, m), profile)
        self.create_subscription(FingerDesign, "/finger_design", self._on_design, qos.LATCHED)
        if self._lockstep:
            self.create_subscription(Header, "/object_pose/rejected", self._on_rejected, qos.STATE)
            self._timer = self.create_timer(0.05, self._answer_if_complete, clock=steady_clock())
        # In a group of its own: waiting for the fingers must not keep them from coming.
        waiting = ReentrantCallbackGroup()
        self._generate = self.create_client(
            GenerateDesign, "/finger_design/generate_design", callback_group=waiting
        )
        # Before ~/start: who finds that one finds this one too.
        self.create_service(PreparePolicy, "~/prepare", self._on_prepare, callback_group=waiting)
        self.create_service(Trigger, "~/start", self._on_start, callback_group=waiting)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.add_on_set_parameters_callback(self._on_set_parameters)
        if not self._lockstep:
            self._timer = self.create_timer(POLICY_PERIOD, self._on_timer, clock=steady_clock())

    @property
    def _name(self) -> str:
        """Of the policy: a name or a path."""
        return self.get_parameter("policy").value

    def _on_set_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Another policy, if it can be loaded and none is at work."""
        for parameter in parameters:
            if parameter.name != "policy":
                continue
            if self._policy is not None:
                return SetParametersResult(
                    successful=False, reason=f"{self._name} is running: call ~/stop first"
                )
            try:
                trained_pair(parameter.value)
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # --- observations

    def _observe(self, key: str, message: Any) -> None:
        self._latest[key] = message
        self._received[key] = time.monotonic()
        if self._lockstep:
            self._answer_if_complete()

    def _on_design(self, message: FingerDesign) -> None:
        self._design, self._decoded = message, None
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

    def _on_rejected(self, message: Header) -> None:
        """A camera saw no object at that moment."""
        self._rejected = nanoseconds(message.stamp)
        self._answer_if_complete()

    def _answer_if_complete(self) -> None:
        """Lockstep: acts once on every moment of the policy's grid, when all is known of it."""
        stamps = {key: nanoseconds(m.header.stamp) for key, m in self._latest.items()}
        now = stamps.get("tcp_pose", -1)
        if self._policy is None or stamps.get("gripper_state") != now:
            return
        if now % PERIOD_NS or now <= self._answered:
            return
        seen = stamps.get("object_pose", NEVER)
        if seen > now or (seen < now and not self._object_is_missing(now)):
            return
        self._answered, self._waiting = now, None
        if now - seen <= self._timeout * 1e9:
            self._act()
        else:
            since = f"for {(now - seen) * 1e-9:.2f} s" if seen != NEVER else "yet"
            self._fault(f"no object_pose {since}")

    def _object_is_missing(self, now: int) -> bool:
        """Whether there will be no pose of this moment: the camera says so, or is silent."""
        if self._waiting is None or self._waiting[0] != now:
            self._waiting = now, time.monotonic()
        return self._rejected == now or time.monotonic() - self._waiting[1] > self._patience

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
        seen = {key: message.header.stamp for key, message in self._latest.items()}
        stamp = self._now()
        self._action_pub.publish(
            messages.action_message(
                action,
                self._sequence,
                stamp,
                object_stamp=seen["object_pose"],
                tcp_stamp=seen["tcp_pose"],
                gripper_stamp=seen["gripper_state"],
            )
        )
        if self._sequence == 1:  # by its stamp a bag tells which actions it belongs to
            self._setup.header.stamp = stamp
            self._setup_pub.publish(self._setup)
        self._state = PolicyStatus.DONE if self._policy.done else PolicyStatus.RUNNING
        self._message = ""
        self._publish_status(stamp)

    def _observation(self) -> Observation:
        return Observation(
            tcp_position=messages.from_xyz(self._latest["tcp_pose"].pose.position),
            object_position=messages.from_xyz(self._latest["object_pose"].pose.position),
            width=self._latest["gripper_state"].width,
            design=self._design_parameters,
        )

    def _fault(self, why: str) -> None:
        """Silent until the observations are good again."""
        self._state, self._message = PolicyStatus.FAULT, why
        self._publish_status(self._now())

    def _now(self) -> Any:
        """Stamp of what is said: in lockstep that of the moment that is answered."""
        if self._lockstep:
            return self._latest["tcp_pose"].header.stamp
        return self.get_clock().now().to_msg()

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

    # --- the design stage

    async def _on_prepare(
        self, _: PreparePolicy.Request, response: PreparePolicy.Response
    ) -> PreparePolicy.Response:
        try:
            fingers = await self._design_stage()
        except ValueError as error:
            response.message = str(error)
            return response
        response.success, response.fingers = True, fingers.content_hash
        response.message = f"{self._name} is ready for fingers {fingers.name}"
        return response

    async def _design_stage(self) -> FingerPair:
        """Sees to it that the policy's own fingers are in use; returns them.

        Raises:
            ValueError: they are not, and why.
        """
        pair = trained_pair(self._name)
        fingers = await self._fingers_in_use()
        wrong = mismatch(pair, fingers) if pair else ""
        if not wrong:
            return fingers
        if not self._orders:
            raise ValueError(
                f"{wrong}: mount its own, then say so by finger_design's ~/generate_design or its "
                "parameter `initial`"
            )
        await self._order(pair)
        return await self._fingers_in_use()

    async def _order(self, pair: TrainedPair) -> None:
        """Has the pair's fingers made and waits until they are in use.

        Raises:
            ValueError: finger_design refuses, or takes too long.
        """
        name = policy_label(self._name) if pair.space else "stock"
        request = GenerateDesign.Request(name=name, cage=pair.space)
        request.parameters = [float(p) for p in pair.design]
        answer: Future | None = None
        started = asked = time.monotonic()
        while mismatch(pair, self._design):
            now = time.monotonic()
            if now - started > self._order_timeout:
                raise ValueError(
                    f"fingers of {self._name} are not in use {self._order_timeout:g} s after they "
                    "were ordered: is finger_design there? See its log, or raise order_timeout"
                )
            if answer is not None and answer.done() and not answer.result().success:
                raise ValueError(f"finger_design: {answer.result().message}")
            if (answer is None or now - asked > ORDER_PATIENCE) and (
                self._generate.service_is_ready()
            ):
                answer, asked = self._generate.call_async(request), now
            await self.sleep(POLICY_PERIOD)

    # --- services

    async def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._policy is not None and not self._policy.done:
            # Asked again, because the first answer was lost; ~/stop comes before a new start.
            response.success, response.message = True, f"{self._name} is running already"
            return response
        try:
            fingers = await self._fingers_in_use()
            around = Surroundings(self._table_height, fingers)
            setup = PolicySetup.of(self._name, around, self._plan_for(fingers))
            self._policy = setup.build(fingers)
        except ValueError as error:
            response.success, response.message = False, str(error)
            return response
        self._design_parameters = np.array(fingers.parameters)
        self._setup = messages.setup_message(setup, fingers.content_hash)
        self._sequence = 0
        self._state, self._message = PolicyStatus.RUNNING, ""
        response.success, response.message = True, f"{self._name} with fingers {fingers.name}"
        if self._lockstep:
            self._answer_if_complete()
        return response

    def _plan_for(self, fingers: FingerPair) -> GraspPlan | None:
        if self._name != SCRIPTED:
            return None
        plan = replace(plan_for(fingers), lift=self._lift).slowed(self._pace)
        return replace(plan, width=self._width) if self._width else plan

    async def _fingers_in_use(self) -> FingerPair:
        """Raises: ValueError: none came, or what came cannot be used."""
        await self._design_or_timeout()
        if self._design is None:
            raise ValueError("no /finger_design yet: start fem_simulator or finger_design")
        if self._decoded is None:
            self._decoded = messages.design_from(self._design)
        return self._decoded

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
