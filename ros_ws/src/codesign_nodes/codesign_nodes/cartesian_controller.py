"""Node cartesian_controller: actions in, joint and gripper set-points out.

At real time a thread of its own steps the servo at absolute deadlines: the executor's wake-ups
are no clock. With use_sim_time the joint state is the clock: each
new stamp is answered with one set-point of the same stamp, and on the policy's grid the set-point
waits for the action that answers that stamp, or for the policy's word that it has none.

With dry_run everything is worked out and reported, no command leaves the node, and /tcp_pose tells
where the hand would be.
"""

import math
import os
import signal
import sys
import threading
import time
from typing import Any

import numpy as np
from codesign_interfaces.action import MoveTo
from codesign_interfaces.msg import (
    ControlAction,
    ControllerStatus,
    FingerDesign,
    GripperCommand,
    GripperState,
    JointCommand,
    PolicyStatus,
)
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from codesign_control import (
    ActionRejected,
    CartesianServo,
    FingerReach,
    GoalState,
    GripperModel,
    Hand,
    Limit,
    MoveRejected,
    Pose,
    ServoConfig,
    ServoOutput,
    ServoState,
    Xarm7,
)
from codesign_control.grasp_frame import (
    displaced_grasp,
    grasp_pose,
    start_posture,
    tcp_translation,
)
from codesign_nodes import messages, qos
from codesign_nodes.mounted import mounted
from codesign_nodes.node_tools import (
    Diagnostics,
    LeanNode,
    declare,
    nanoseconds,
    run,
    stamp_of,
    steady_clock,
)
from codesign_policy.task import MAX_TRANSLATION, MAX_WIDTH_CHANGE, POLICY_PERIOD

ACTION_PERIOD_NS = round(POLICY_PERIOD * 1e9)
STATUS_PERIOD = 0.05  # s
FRESH_STATE_TIMEOUT = 4.0  # s, wait of ~/enable for a joint state
LONGEST_STOP = 100  # control periods
MAX_CATCH_UP = 5  # control periods that a late timer makes up for
GRID_TOLERANCE_NS = 100_000_000
UNTRACKED = 100.0  # rad: with dry_run the arm does not follow, which is no fault
MIN_GRIPPER_SPEED = 0.015  # m/s, slower ones the gripper does not accept


class CartesianController(LeanNode):
    """Wraps `CartesianServo` and keeps the gripper's target."""

    def __init__(self) -> None:
        super().__init__("cartesian_controller")
        self._dry_run = declare(
            self, "dry_run", False, "work everything out, publish no joint or gripper command"
        )
        self._config = self._declare_config()
        self._wait_limit = declare(
            self,
            "lockstep_timeout",
            10.0,
            "wall time that a simulated tick waits for the policy's action [s]",
            low=0.1,
            high=60.0,
        )
        self._lockstep = self.get_parameter("use_sim_time").value
        self._arm = Xarm7()
        self._servo = CartesianServo(self._arm, self._config)
        self._gripper = GripperModel()
        self._reach: FingerReach | None = None
        self._next_fingers: tuple[GripperModel, FingerReach] | None = None
        self._joint_state: JointState | None = None
        self._gripper_state: GripperState | None = None
        self._measured: np.ndarray | None = None
        self._measured_is_new = False
        self._observations = 0
        self._width = math.nan  # measured
        self._width_sent: float | None = None  # since actions are followed
        self._last_action = ControlAction()
        self._rejected = 0
        self._last_error = ""
        self._output: ServoOutput | None = None
        self._commands: tuple[JointCommand, GripperCommand | None] | None = None
        self._fresh: Future | None = None
        self._goal_done: Future | None = None
        self._status_at = 0.0
        self._limits = Limit.NONE  # since the last status
        # The control thread and the executor's callbacks share the servo.
        self._lock = threading.RLock()
        self._closing = threading.Event()
        self._started_at = time.monotonic()
        self._steps = 0
        self._steps_skipped = 0
        self._grid_origin = self.get_clock().now().nanoseconds
        # Lockstep: the tick in hand, and whether a policy answers at all.
        self._pending: Any = None
        self._pending_since = 0.0
        self._stepped = -1
        self._answered = -1
        self._now = 0.0
        self._policy_absent = False
        self._make_interfaces()
        self._diagnostics = Diagnostics(self, self._report)

    def _declare_config(self) -> ServoConfig:
        d = ServoConfig()
        self._table_height = table = declare(
            self, "table_height", 0.0, "z of the table in link_base [m]", low=-0.5, high=0.5
        )
        return ServoConfig(
            action_period=POLICY_PERIOD,
            action_timeout=declare(
                self,
                "action_timeout",
                d.action_timeout,
                "age of an action above which the arm halts [s]",
                low=0.05,
                high=1.0,
            ),
            # The four-bar's z motion comes on top of what a policy may ask for.
            action_translation=0.015,
            linear_speed=declare(
                self, "linear_speed", d.linear_speed, "of link_tcp [m/s]", low=0.01, high=0.5
            ),
            angular_speed=declare(
                self, "angular_speed", d.angular_speed, "of link_tcp [rad/s]", low=0.05, high=2.0
            ),
            box_lower=(d.box_lower[0], d.box_lower[1], table + d.box_lower[2]),
            box_upper=(d.box_upper[0], d.box_upper[1], table + d.box_upper[2]),
            table_height=table,
            self_collision_margin=declare(
                self,
                "self_collision_margin",
                d.self_collision_margin,
                "least distance of two links that could meet [m]",
                low=0.001,
                high=0.05,
            ),
            tracking_limit=UNTRACKED if self._dry_run else d.tracking_limit,
        )

    def _make_interfaces(self) -> None:
        self._joint_pub = self.create_publisher(
            JointCommand, "/joint_command", qos.JOINT_COMMAND_OFFERED
        )
        self._gripper_pub = self.create_publisher(
            GripperCommand, "/gripper_command", qos.GRIPPER_COMMAND_OFFERED
        )
        self._pose_pub = self.create_publisher(PoseStamped, "/tcp_pose", qos.POSE_OFFERED)
        self._status_pub = self.create_publisher(ControllerStatus, "~/status", qos.STATE_OFFERED)
        self.create_subscription(ControlAction, "/action", self._on_action, qos.ACTION_REQUESTED)
        self.create_subscription(JointState, "/joint_states", self._on_joint_state, qos.STATE)
        self.create_subscription(GripperState, "/gripper_state", self._on_gripper, qos.STATE)
        self.create_subscription(FingerDesign, "/finger_design", self._on_design, qos.LATCHED)
        # These wait for a joint state; in a group of their own they do not keep it from coming.
        waiting = ReentrantCallbackGroup()
        self.create_service(SetBool, "~/enable", self._on_enable, callback_group=waiting)
        self.create_service(Trigger, "~/reset_fault", self._on_reset_fault, callback_group=waiting)
        self._server = ActionServer(
            self,
            MoveTo,
            "~/move_to",
            execute_callback=self._execute_move,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=self._on_cancel,
            callback_group=waiting,
        )
        if self._lockstep:
            self.create_subscription(PolicyStatus, "/policy/status", self._on_policy, qos.EVERY)
            self._timer = self.create_timer(0.05, self._give_up_waiting, clock=steady_clock())
        else:
            # The thread asks for the interpreter 100 times a second, and not only when the
            # executor has had it for the default 5 ms.
            sys.setswitchinterval(0.0005)
            self._thread = threading.Thread(target=self._control, name="control", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Ends the control thread."""
        self._closing.set()
        if not self._lockstep:
            self._thread.join(1.0)

    # --- the control step

    def _control(self) -> None:
        """Real time: wakes at absolute deadlines until the node is closed."""
        period = self._config.period
        while not self._closing.is_set():
            due_in = self._started_at + (self._steps + 1) * period - time.monotonic()
            if due_in > 0.0:
                time.sleep(due_in)
            elif due_in < -MAX_CATCH_UP * period:
                # The whole process stood still. What arrived meanwhile waits to be taken in: the
                # watchdogs must not judge by what was there before.
                time.sleep(period / 2.0)
            try:
                with self._lock:
                    self._catch_up()
            except Exception as error:
                if self.context.ok():
                    self.get_logger().fatal(f"control stopped: {type(error).__name__}: {error}")
                    os.kill(os.getpid(), signal.SIGINT)
                return

    def _catch_up(self) -> None:
        """As many steps as have come due, so that a late wake-up does not halt the hand.

        Motion that pauses and goes on at full speed would be a blow to what is held.
        """
        period = self._config.period
        due = int((time.monotonic() - self._started_at) / period + 1e-6) - self._steps
        if due > MAX_CATCH_UP:
            self._steps += due - MAX_CATCH_UP
            self._steps_skipped += due - MAX_CATCH_UP
        for _ in range(min(due, MAX_CATCH_UP)):
            self._step_on_grid()

    def _answer_at_once(self) -> None:
        """An action's first set-point goes out now, up to a period ahead of its moment."""
        ahead = self._started_at + (self._steps + 1) * self._config.period - time.monotonic()
        if 0.0 < ahead <= self._config.period:
            self._step_on_grid()

    def _step_on_grid(self) -> None:
        self._steps += 1
        self._now = time.monotonic()
        now = self.get_clock().now().nanoseconds
        self._step(now, self._moment(now))

    def _moment(self, now: int) -> int:
        """What this step is meant for, on an even grid [ns]; a jump of the clock moves it."""
        on_grid = self._grid_origin + round(self._steps * self._config.period * 1e9)
        if abs(on_grid - now) > GRID_TOLERANCE_NS:
            self._grid_origin += now - on_grid
            return now
        return on_grid

    def _step(self, now: int, valid_at: int) -> None:
        """One set-point. Both times in nanoseconds: when it is made, what it is meant for."""
        measured = self._measured if self._measured_is_new else None
        self._measured_is_new = False
        output = self._servo.step(measured, self._now)
        changed = self._output is None or output.state != self._output.state
        self._output = output
        self._limits |= output.limits
        if not self._lockstep:
            now = self.get_clock().now().nanoseconds
        stamp = stamp_of(now)
        if output.active:
            slow = self._is_slow_tick(valid_at)
            gripper = self._gripper_command(output, stamp) if slow else None
            self._commands = (self._joint_command(output, stamp, stamp_of(valid_at)), gripper)
            self._publish_commands()
        else:
            self._commands = None
        if changed or time.monotonic() - self._status_at > STATUS_PERIOD:
            self._publish_status(stamp)
        if self._goal_done is not None and output.goal is not GoalState.RUNNING:
            self._goal_done.set_result(output.goal)
            self._goal_done = None

    def _joint_command(self, output: ServoOutput, stamp: Any, valid_at: Any) -> JointCommand:
        message = JointCommand(
            valid_at=valid_at,
            position=output.position,
            velocity=output.velocity,
            action_stamp=self._last_action.header.stamp,
            action_sequence=self._last_action.sequence,
        )
        message.header.stamp = stamp
        return message

    def _gripper_command(self, output: ServoOutput, stamp: Any) -> GripperCommand:
        width = self._gap_target() if output.gripper is None else output.gripper
        message = GripperCommand(width=width, speed=self._gripper_speed(width))
        message.header.stamp = stamp
        return message

    def _gripper_speed(self, width: float) -> float:
        """With which the gap is there when the next command comes [m/s]; 0, the gripper's own,
        before the first action. What a wait for the table held up is thus caught up with."""
        if self._width_sent is None:
            return 0.0
        change, self._width_sent = abs(width - self._width_sent), width
        return max(change / POLICY_PERIOD, MIN_GRIPPER_SPEED)

    def _is_slow_tick(self, valid_at: int) -> bool:
        """Whether the gripper is due: 20 times a second, on the policy's grid in lockstep."""
        if self._lockstep:
            return valid_at % ACTION_PERIOD_NS == 0
        return self._steps % round(POLICY_PERIOD / self._config.period) == 0

    def _publish_commands(self) -> None:
        if self._commands is None or self._dry_run:
            return
        joints, gripper = self._commands
        if gripper is not None:
            self._gripper_pub.publish(gripper)
        self._joint_pub.publish(joints)

    def _gap_target(self) -> float:
        """What the gripper is to do now: hold what it measures until something else is asked."""
        asked = self._servo.gripper_asked
        return self._width if asked is None else asked

    # --- observations

    def _on_joint_state(self, message: JointState) -> None:
        if len(message.position) < 7:
            self._reject(f"joint state with {len(message.position)} positions: must be 7")
            return
        with self._lock:
            self._joint_state = message
            if self._lockstep:
                self._observe_if_complete()
            elif self._gripper_state is not None:
                self._observe()

    def _observe_if_complete(self) -> None:
        """Lockstep: arm and gripper of the same tick, in whatever order they arrive.

        The gripper reports on the policy's grid only; in between its last state counts. One that
        is newer than the arm's is of a tick whose arm state is still on its way: after a reset
        that one is elsewhere.
        """
        arm, gripper = self._joint_state, self._gripper_state
        if arm is None or gripper is None:
            return
        now = nanoseconds(arm.header.stamp)
        if not now - now % ACTION_PERIOD_NS <= nanoseconds(gripper.header.stamp) <= now:
            return
        self._observe()
        self._on_simulated_tick(arm.header.stamp)

    def _observe(self) -> None:
        """Takes in where arm and gripper are, and publishes the grasp frame."""
        self._measured = np.array(self._joint_state.position[:7])
        self._measured_is_new = True
        self._width = self._gripper_state.width
        self._servo.observe_gripper(self._width)
        self._observations += 1
        if self._pose_is_due() and np.isfinite(self._measured).all():
            self._publish_pose(self._joint_state.header.stamp)
        if self._fresh is not None and not self._fresh.done():
            self._fresh.set_result(True)

    def _pose_is_due(self) -> bool:
        """Every second time, 50 Hz; in lockstep whenever the policy looks."""
        if self._lockstep:
            return nanoseconds(self._joint_state.header.stamp) % ACTION_PERIOD_NS == 0
        return self._observations % 2 == 0

    def _publish_pose(self, stamp: Any) -> None:
        joints, width = self._measured, self._width
        if self._dry_run and self._output is not None and self._output.active:
            joints, width = self._output.position, self._gap_target()
        pose = grasp_pose(self._arm, self._gripper, joints, width)
        message = PoseStamped(pose=messages.pose(pose.position, pose.quaternion))
        message.header.stamp = stamp
        message.header.frame_id = "link_base"
        self._pose_pub.publish(message)

    def _on_gripper(self, message: GripperState) -> None:
        if not math.isfinite(message.width):
            self._reject(f"gripper state with width {message.width} m: must be finite")
            return
        with self._lock:
            self._gripper_state = message
            if self._lockstep:
                self._observe_if_complete()

    def _on_design(self, message: FingerDesign) -> None:
        try:
            fingers = messages.design_from(message)
            gripper = mounted(fingers)
        except ValueError as error:
            self._reject(str(error))
            return
        with self._lock:
            reach = FingerReach(fingers.left.vertices, fingers.right.vertices)
            self._next_fingers = gripper, reach
            self._change_fingers()

    def _change_fingers(self) -> None:
        """Never in the middle of a trial: the grasp frame would jump."""
        if self._next_fingers is None:
            return
        try:
            self._servo.set_hand(Hand(*self._next_fingers))
        except MoveRejected:  # enabled or still braking: ~/enable tries again
            return
        (self._gripper, self._reach), self._next_fingers = self._next_fingers, None

    # --- lockstep

    def _on_simulated_tick(self, stamp: Any) -> None:
        now = nanoseconds(stamp)
        if now == self._stepped:
            self._publish_commands()  # the simulator asks again: the last answer was lost
            return
        if self._pending is None or nanoseconds(self._pending) != now:
            self._pending, self._pending_since = stamp, time.monotonic()
        self._step_if_ready()

    def _step_if_ready(self) -> None:
        if self._pending is None or self._waits_for_action():
            return
        self._stepped, self._pending = nanoseconds(self._pending), None
        self._now = self._stepped * 1e-9
        self._step(self._stepped, self._stepped)

    def _waits_for_action(self) -> bool:
        now = nanoseconds(self._pending)
        follows = self._servo.state in (ServoState.READY, ServoState.MOVING, ServoState.HALTED)
        if not follows or self._goal_done is not None or now % ACTION_PERIOD_NS:
            return False
        return self._answered != now and not self._policy_absent

    def _give_up_waiting(self) -> None:
        """A dead policy must not stop simulated time: the servo's watchdog has to see it go by."""
        if self._pending is None or not self._waits_for_action():
            return
        if time.monotonic() - self._pending_since > self._wait_limit:
            self._policy_absent = True
            self._step_if_ready()

    def _on_policy(self, message: PolicyStatus) -> None:
        """A policy at fault has no action for that moment: time goes on, the watchdog sees it."""
        if message.state == PolicyStatus.FAULT:
            with self._lock:
                self._answered = nanoseconds(message.header.stamp)
                self._step_if_ready()

    # --- actions

    def _on_action(self, message: ControlAction) -> None:
        with self._lock:
            self._take_action(message)

    def _take_action(self, message: ControlAction) -> None:
        if self._lockstep and self._pending is not None:
            self._now = nanoseconds(self._pending) * 1e-9
        try:
            self._submit(message)
            if not self._lockstep:
                self._answer_at_once()
        except ActionRejected as error:
            self._last_error = str(error)
            self.get_logger().warning(f"rejected: {error}", throttle_duration_sec=1.0)
        except ValueError as error:
            self._reject(str(error))
        if self._lockstep:
            self._answered = nanoseconds(message.tcp_stamp)
            self._policy_absent = False
            self._step_if_ready()

    def _submit(self, message: ControlAction) -> None:
        """Takes one action; ValueError when there is something wrong with it."""
        if message.header.frame_id != "link_base":
            raise ValueError(f"action in frame {message.header.frame_id!r}: must be link_base")
        if not (math.isfinite(message.width) and abs(message.width) <= MAX_WIDTH_CHANGE * 1.001):
            raise ValueError(
                f"action changes the gap by {message.width} m: at most {MAX_WIDTH_CHANGE} m"
            )
        translation = messages.from_xyz(message.translation)
        rotation = messages.from_xyz(message.rotation)
        before = self._gap_target()
        after = self._gripper.clip(before + message.width)
        if np.isfinite(translation).all() and np.isfinite(rotation).all():
            translation = self._above_table(translation, rotation, before, after)
            translation = tcp_translation(
                self._servo.reference_pose, self._gripper, translation, rotation, before, after
            )
        now = self._now if self._lockstep else time.monotonic()
        self._servo.submit(translation, rotation, now)
        self._servo.ask_gripper(after)
        if self._width_sent is None:
            self._width_sent = before
        self._last_action = message

    def _above_table(
        self, translation: np.ndarray, rotation: np.ndarray, before: float, after: float
    ) -> np.ndarray:
        """The translation, raised where fingers would go into the table, by one action at most."""
        if self._reach is None:
            return translation
        tcp = self._servo.reference_pose
        grasp = displaced_grasp(tcp, self._gripper, translation, rotation, before)
        # The arm turns with a lag: what it leaves may need more room than what it turns to.
        turning = Pose(grasp.position, self._servo.commanded_pose.quaternion)
        lowest = min(self._reach.lowest(pose, after) for pose in (grasp, turning))
        sunk = self._table_height - lowest
        raised = translation.copy()
        raised[2] += np.clip(sunk, 0.0, max(MAX_TRANSLATION[2] - translation[2], 0.0))
        return raised

    def _reject(self, why: str) -> None:
        self._rejected += 1
        self._last_error = why
        self.get_logger().warning(f"rejected: {why}", throttle_duration_sec=1.0)

    # --- services and the move_to action

    async def _on_enable(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        if not request.data:
            with self._lock:
                self._servo.disable()
                self._finish_braking()
                self._change_fingers()
            response.success, response.message = True, "disabled"
            return response
        if self._servo.state not in (ServoState.DISABLED, ServoState.FAULT):
            # Asked again, because the first answer was lost.
            response.success, response.message = True, "enabled already"
            return response
        with self._lock:
            self._change_fingers()
        if not await self._fresh_state():
            response.message = f"no /joint_states within {FRESH_STATE_TIMEOUT} s"
            return response
        if self._servo.state not in (ServoState.DISABLED, ServoState.FAULT):
            response.success, response.message = True, "enabled meanwhile"
            return response
        try:
            with self._lock:
                self._servo.enable(self._measured, self._time())
                self._policy_absent = False
                self._width_sent = None
                # Lockstep: the tick that stood while disabled wants an answer now.
                self._stepped = -1
                self._last_action = ControlAction()
        except MoveRejected as error:
            response.message = str(error)
            return response
        response.success, response.message = True, "holding"
        return response

    def _finish_braking(self) -> None:
        """Lockstep: time may stand still until the next reset puts the arm elsewhere; a stop that
        is then still going on would drag it back."""
        for _ in range(LONGEST_STOP):
            if not self._lockstep or not self._servo.step(None, self._now).active:
                return

    async def _on_reset_fault(
        self, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        if self._servo.state is not ServoState.FAULT:
            response.success, response.message = True, "no fault"
            return response
        if not await self._fresh_state():
            response.message = f"no /joint_states within {FRESH_STATE_TIMEOUT} s"
            return response
        if self._servo.state is not ServoState.FAULT:  # asked twice: the other one was faster
            response.success, response.message = True, "no fault any more"
            return response
        try:
            with self._lock:
                self._finish_braking()
                self._servo.reset_fault(self._measured, self._time())
        except MoveRejected as error:
            response.message = str(error)
            return response
        response.success, response.message = True, "disabled, call ~/enable"
        return response

    async def _fresh_state(self) -> bool:
        """Waits for a joint state that arrives from now on."""
        fresh = Future()
        self._fresh = fresh

        def expire() -> None:
            if not fresh.done():
                fresh.set_result(False)

        timer = self.create_timer(FRESH_STATE_TIMEOUT, expire, clock=steady_clock())
        arrived = await fresh
        self.destroy_timer(timer)
        return bool(arrived)

    def _time(self) -> float:
        return self._now if self._lockstep else time.monotonic()

    def _on_cancel(self, _: Any) -> CancelResponse:
        with self._lock:
            self._servo.cancel()
        return CancelResponse.ACCEPT

    async def _execute_move(self, goal: Any) -> MoveTo.Result:
        request = goal.request
        result = MoveTo.Result()
        try:
            done = self._start_move(request)
        except (MoveRejected, ValueError) as error:
            result.message = str(error)
            goal.abort()
            return result
        outcome = await done
        result.success = outcome is GoalState.REACHED
        result.message = outcome.value
        if result.success:
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            goal.abort()
        return result

    def _start_move(self, request: MoveTo.Goal) -> Future:
        with self._lock:
            target = self._move_target(request)
            self._servo.move_to(target, self._time(), request.speed_scale or 0.3)
            if math.isfinite(request.width):
                self._servo.ask_gripper(self._gripper.clip(request.width))
                self._width_sent = None
            self._goal_done = Future()
            return self._goal_done

    def _move_target(self, request: MoveTo.Goal) -> Any:
        """Joints, or a pose of link_tcp, or the start posture when neither is given."""
        if len(request.joints):
            return np.array(request.joints)
        if not request.pose.header.frame_id:
            asked = request.width if math.isfinite(request.width) else self._gap_target()
            return start_posture(self._arm, self._gripper, self._gripper.clip(asked))
        if request.pose.header.frame_id != "link_base":
            raise ValueError(f"pose in frame {request.pose.header.frame_id!r}: must be link_base")
        pose = request.pose.pose
        return Pose(messages.from_xyz(pose.position), messages.from_quaternion(pose.orientation))

    # --- reports

    def _publish_status(self, stamp: Any) -> None:
        assert self._output is not None
        self._status_at = time.monotonic()
        counters, near = self._output.counters, self._servo.proximity()
        message = ControllerStatus(
            state=int(self._output.state),
            message=self._output.message,
            actions_accepted=counters.actions_accepted,
            actions_rejected=counters.actions_rejected + self._rejected,
            halts=counters.halts,
            singularity_scale=self._output.singularity_scale,
            tracking_error=self._output.tracking_error,
            limits=int(self._limits),
            faults=counters.faults,
            brakes=counters.brakes,
            self_distance=near.self_distance,
            nearest_links=" - ".join(near.links),
            table_room=near.table_room,
            dry_run=self._dry_run,
        )
        self._limits = Limit.NONE
        message.header.stamp = stamp
        self._status_pub.publish(message)

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        if self._output is None:
            return DiagnosticStatus.WARN, "waiting for /joint_states", {}
        level = {
            ServoState.HALTED: DiagnosticStatus.WARN,
            ServoState.FAULT: DiagnosticStatus.ERROR,
        }.get(self._output.state, DiagnosticStatus.OK)
        with self._lock:
            near = self._servo.proximity()
        counters = vars(self._output.counters) | {
            "steps_skipped": self._steps_skipped,
            "messages_rejected": self._rejected,
            "last_rejection": self._last_error,
            "dry_run": self._dry_run,
            "self_distance_m": round(near.self_distance, 4),
            "nearest_links": " - ".join(near.links),
            "table_room_m": round(near.table_room, 4),
            "singularity_scale": round(self._output.singularity_scale, 3),
        }
        # Control periods in which a limit slowed or stopped the motion.
        counters |= {f"at_{name.lower()}": n for name, n in self._servo.limit_ticks.items()}
        said = f"{self._output.state.name.lower()}: {self._output.message}"
        return level, f"dry run, {said}" if self._dry_run else said, counters


def main() -> None:
    """Runs the node."""
    run(CartesianController)
