"""Node trial_runner: one trial as one action: prepare, reset, start, wait, judge, record.

With a simulator in the graph the object and the arm are reset through it; without one the arm
moves to its start posture and a person puts the object there. With a real arm and a simulated block
the arm moves, then the simulator puts a new block down.
"""

import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from codesign_interfaces.action import MoveTo, RunTrial
from codesign_interfaces.msg import (
    ControllerStatus,
    GripperState,
    PolicyStatus,
    Stress,
    TrialDomain,
    TrialMetrics,
    TrialState,
)
from codesign_interfaces.srv import (
    PreparePolicy,
    ResetSimulation,
    StartRecording,
    StopRecording,
)
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from codesign_nodes import messages, qos
from codesign_nodes.node_tools import (
    Diagnostics,
    LeanNode,
    declare,
    nanoseconds,
    run,
    stamp_of,
    steady_clock,
)
from codesign_policy.metrics import GraspMetrics, grasp_metrics, pose_metrics

RESETS = 5  # until the simulator wears the fingers that the policy is ready for
# s; an arm's driver begins with commands that stand where the arm stands, and needs to see some.
MATCH_PAUSE = 0.5
RESET_PAUSE = 0.5  # s
LAST_SAMPLES = 5.0  # s, longest wait for them on a busy machine
OPENED = 0.002  # m, a gripper this close to its gap has it
FOLLOWED = 0.02  # rad, a real arm this close to its set-points follows them


class TrialError(RuntimeError):
    """A step of the trial failed; the message says which and why."""


@dataclass
class TrialLog:
    """What the metrics need, by stamp in nanoseconds."""

    stress: dict[int, Stress] = field(default_factory=dict)
    place: dict[int, NDArray[np.float64]] = field(default_factory=dict)  # of the object
    tool: dict[int, NDArray[np.float64]] = field(default_factory=dict)  # a real arm's
    width: dict[int, float] = field(default_factory=dict)  # a real gripper's
    start: int | None = None
    end: int | None = None


class TrialRunner(LeanNode):
    """Serves the action /run_trial, one goal at a time."""

    def __init__(self) -> None:
        super().__init__("trial_runner")
        self._timeout = declare(
            self, "timeout", 30.0, "longest time of the policy [s]", low=1.0, high=600.0
        )
        self._service_timeout = declare(
            self, "service_timeout", 5.0, "longest wait for an answer [s]", low=0.1, high=60.0
        )
        self._prepare_timeout = declare(
            self,
            "prepare_timeout",
            130.0,
            "longest wait for the policy's design stage [s]",
            low=0.1,
            high=3600.0,
        )
        self._startup_timeout = declare(
            self,
            "startup_timeout",
            40.0,
            "longest wait for another node to appear; the simulator may compile first [s]",
            low=0.0,
            high=600.0,
        )
        self._simulated = declare(self, "simulated", True, "the graph has a fem_simulator")
        self._virtual = declare(
            self,
            "virtual_block",
            False,
            "with simulated: false: the block is simulated, in the hands of a real arm",
        )
        if self._virtual and self._simulated:
            raise ValueError("virtual_block is for a real arm: it needs simulated: false")
        self._object_topic = declare(
            self,
            "object_pose_topic",
            "/object_pose",
            "by which the lift is judged; the true pose where a simulator has one beside a camera",
        )
        self._home_speed = declare(
            self,
            "home_speed",
            0.3,
            "of the way to the start posture on a real arm, share of the joints' velocity limit",
            low=0.01,
            high=1.0,
        )
        self._home_width = declare(
            self,
            "home_width",
            0.0,
            "gap to open to on that way [m]; 0: the gripper keeps its gap, and what it holds",
            low=0.0,
            high=0.084,
        )
        self._dry_run = declare(
            self, "dry_run", False, "the arm is told not to move: a trial shows what would be sent"
        )
        self._silence = declare(
            self,
            "policy_silence",
            5.0,
            "without any word from the policy for this long, or at fault for this long, the trial "
            "fails [s]",
            low=0.5,
            high=60.0,
        )
        self._lockstep = self.get_parameter("use_sim_time").value
        self._goal: Any = None
        self._state = TrialState(state=TrialState.IDLE)
        self._log = TrialLog()
        self._tracking_error = math.inf  # of a real arm [rad]
        self._controller = ControllerStatus()
        self._faults_before = 0  # of the controller, before it was enabled
        self._gap, self._gap_moves = math.nan, True  # of a real gripper [m]
        self._seen = 0  # stamp of the newest pose that a camera told of a simulated block [ns]
        self._ended: Future | None = None
        self._heard_at = self._good_at = 0.0
        self._make_interfaces()
        self._diagnostics = Diagnostics(self, self._report)
        if self._dry_run:
            self.get_logger().warning("DRY RUN: trials are run, nothing is to move")

    def _make_interfaces(self) -> None:
        self._state_pub = self.create_publisher(TrialState, "/trial_state", qos.LATCHED)
        self.create_subscription(PolicyStatus, "/policy/status", self._on_policy, qos.EVERY)
        self.create_subscription(Stress, "/stress", self._on_stress, qos.EVERY)
        self.create_subscription(PoseStamped, self._object_topic, self._on_pose, qos.EVERY)
        self.create_subscription(
            ControllerStatus, "/cartesian_controller/status", self._on_controller, qos.EVERY
        )
        if not self._simulated:  # by these a grasp is judged where no stress is known
            self.create_subscription(PoseStamped, "/tcp_pose", self._on_tool, qos.EVERY)
            self.create_subscription(GripperState, "/gripper_state", self._on_gripper, qos.EVERY)
        if self._virtual:
            self.create_subscription(PoseStamped, "/object_pose", self._on_sight, qos.STATE)
        self._reset = self.create_client(ResetSimulation, "/fem_simulator/reset")
        self._pause = self.create_client(Trigger, "/fem_simulator/pause")
        self._resume = self.create_client(Trigger, "/fem_simulator/resume")
        self._enable = self.create_client(SetBool, "/cartesian_controller/enable")
        self._reset_fault = self.create_client(Trigger, "/cartesian_controller/reset_fault")
        self._move_to = ActionClient(self, MoveTo, "/cartesian_controller/move_to")
        self._prepare_policy = self.create_client(PreparePolicy, "/policy/prepare")
        self._start_policy = self.create_client(Trigger, "/policy/start")
        self._stop_policy = self.create_client(Trigger, "/policy/stop")
        self._start_recording = self.create_client(StartRecording, "/trial_recorder/start")
        self._stop_recording = self.create_client(StopRecording, "/trial_recorder/stop")
        self._server = ActionServer(
            self,
            RunTrial,
            "/run_trial",
            execute_callback=self._execute,
            goal_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )
        self._timer = self.create_timer(0.1, self._watch, clock=steady_clock())

    # --- what goes by

    def _on_policy(self, message: PolicyStatus) -> None:
        self._heard_at = time.monotonic()
        if message.state != PolicyStatus.FAULT:
            self._good_at = self._heard_at
        if self._ended is None:
            return
        stamp = nanoseconds(message.header.stamp)
        if message.state == PolicyStatus.RUNNING and self._log.start is None:
            self._log.start = stamp
        if message.state == PolicyStatus.DONE and self._log.end is None:
            self._log.end = stamp
            self._end("")

    def _on_stress(self, message: Stress) -> None:
        if self._goal is not None:
            self._log.stress[nanoseconds(message.header.stamp)] = message

    def _on_pose(self, message: PoseStamped) -> None:
        if self._goal is not None:
            self._log.place[nanoseconds(message.header.stamp)] = _position(message)

    def _on_tool(self, message: PoseStamped) -> None:
        if self._goal is not None:
            self._log.tool[nanoseconds(message.header.stamp)] = _position(message)

    def _on_gripper(self, message: GripperState) -> None:
        self._gap, self._gap_moves = message.width, message.moving
        if self._goal is not None:
            self._log.width[nanoseconds(message.header.stamp)] = message.width

    def _on_sight(self, message: PoseStamped) -> None:
        self._seen = nanoseconds(message.header.stamp)

    def _on_controller(self, message: ControllerStatus) -> None:
        self._tracking_error = message.tracking_error
        self._controller = message

    def _watch(self) -> None:
        """Ends a trial that cannot end by itself; feeds the goal's feedback."""
        if self._ended is None or self._ended.done():
            return
        now = time.monotonic()
        self._state.elapsed = self._elapsed()
        self._publish_state()
        self._goal.publish_feedback(RunTrial.Feedback(state=self._state))
        limit = self._goal.request.timeout or self._timeout
        if self._goal.is_cancel_requested:
            self._end("canceled")
        elif self._fault():
            self._end(self._fault())
        elif self._state.elapsed > limit:
            self._end(f"the policy was not done after {limit} s")
        elif now - self._heard_at > self._silence:
            self._end(f"no word from the policy for {self._silence} s")
        elif now - self._good_at > self._silence:
            self._end(f"the policy was at fault for {self._silence} s")

    def _fault(self) -> str:
        """What the controller says of a fault in this trial; empty without one."""
        if self._controller.faults <= self._faults_before:
            return ""
        return f"cartesian_controller at fault: {self._controller.message}"

    def _elapsed(self) -> float:
        """Since the policy's start, by the stamps of what was observed [s]."""
        if self._log.start is None or not self._log.place:
            return 0.0
        return max(0.0, (max(self._log.place) - self._log.start) * 1e-9)

    def _end(self, why: str) -> None:
        if self._ended is not None and not self._ended.done():
            self._ended.set_result(why)

    # --- the action

    def _on_goal(self, _: Any) -> GoalResponse:
        return GoalResponse.REJECT if self._goal is not None else GoalResponse.ACCEPT

    async def _execute(self, goal: Any) -> RunTrial.Result:
        self._log = TrialLog()
        self._goal = goal
        request = goal.request
        result = RunTrial.Result(bag=request.bag)
        recording = False
        try:
            self._set_state(TrialState.PREPARING, "", request)
            result.domain = await self._prepare(request)
            self._state.domain = result.domain
            if request.bag:
                await self._call(self._start_recording, StartRecording.Request(uri=request.bag))
                recording = True
            await self._let_policy_work(request)
            result.metrics = self._metrics()
            self._state.started = stamp_of(self._log.start or 0)
            self._state.ended = stamp_of(self._log.end or 0)
            result.success = result.metrics.success
            result.message = "picked up" if result.success else "not lifted and held"
            if self._dry_run:
                result.message = "dry run: nothing moved"
            self._state.metrics = result.metrics
            self._set_state(TrialState.FINISHED, result.message, request)
        except TrialError as error:
            result.message = str(error)
            self._set_state(TrialState.FAILED, result.message, request)
        finally:
            await self._finish(recording, result)
        if goal.is_cancel_requested:
            goal.canceled()
        elif self._state.state == TrialState.FINISHED:
            goal.succeed()
        else:
            goal.abort()
        self._goal = None
        return result

    async def _prepare(self, request: RunTrial.Goal) -> TrialDomain:
        fingers = await self._design_stage()
        domain = TrialDomain()
        if self._simulated:
            domain = await self._reset_with(fingers, request)
            # A simulated arm needs no person to look at it before it goes on.
            await self._call(self._reset_fault, Trigger.Request())
        self._faults_before = self._controller.faults
        await self._call(self._enable, SetBool.Request(data=True))
        if not self._simulated:
            await self.sleep(MATCH_PAUSE)
            await self._go_home()
        if self._virtual:
            domain = await self._reset_with(fingers, request)
            await self._until_seen()
        return domain

    async def _design_stage(self) -> str:
        """Content hash of the fingers that the policy is ready for; empty if it does not say."""
        await self._until_there(self._start_policy)
        if not self._prepare_policy.service_is_ready():  # a person at the controls
            return ""
        asks = math.ceil(self._prepare_timeout / self._service_timeout)
        request = PreparePolicy.Request()
        return (await self._call(self._prepare_policy, request, asks)).fingers

    async def _reset_with(self, fingers: str, request: RunTrial.Goal) -> TrialDomain:
        """Resets until these fingers are on: new ones may reach the policy before the simulator."""
        reset = ResetSimulation.Request(
            seed=request.seed, domain=request.domain, paused=self._lockstep
        )
        for _ in range(RESETS):
            answer = await self._call(self._reset, reset)
            if fingers in ("", answer.fingers):
                return answer.domain
            await self.sleep(RESET_PAUSE)
        raise TrialError(
            f"the simulator has fingers {answer.fingers[:12]} on, the policy is ready for "
            f"{fingers[:12]}: see the simulator's log"
        )

    async def _until_seen(self) -> None:
        """Raises TrialError when nobody tells where the new block is: the old one is still told of
        for a moment."""
        reset_at = self.get_clock().now().nanoseconds
        until = time.monotonic() + self._startup_timeout
        while time.monotonic() < until:
            if self._seen > reset_at:
                return
            await self.sleep(0.05)
        raise TrialError(
            f"no /object_pose of the new block within {self._startup_timeout} s: see the logs of "
            "the camera and of tofu_pose_estimator"
        )

    async def _go_home(self) -> None:
        if not self._move_to.wait_for_server(self._service_timeout):
            raise TrialError("cartesian_controller offers no move_to action")
        goal = await self._move_to.send_goal_async(
            MoveTo.Goal(width=self._home_width or math.nan, speed_scale=self._home_speed)
        )
        if not goal.accepted:
            raise TrialError("cartesian_controller refused to move to the start posture")
        result = (await goal.get_result_async()).result
        if not result.success:
            raise TrialError(f"start posture not reached: {self._fault() or result.message}")
        if not self._dry_run:
            await self._until_followed()
            if self._home_width:
                await self._until_open()

    async def _until_followed(self) -> None:
        """Raises TrialError when the arm is not where the set-points went, as a disabled one."""
        for _ in range(40):
            if self._tracking_error < FOLLOWED:
                return
            await self.sleep(0.05)
        raise TrialError(
            f"the arm is {self._tracking_error:.3f} rad away from the start posture: is its driver "
            "enabled? `operate status` says, `operate enable` does it"
        )

    async def _until_open(self) -> None:
        """Returns once the gripper has its gap, or stands where the fingers stop it."""
        until = time.monotonic() + self._service_timeout
        while time.monotonic() < until and not abs(self._gap - self._home_width) < OPENED:
            stands = not self._gap_moves and time.monotonic() > until - self._service_timeout + 1.0
            if stands:
                return
            await self.sleep(0.05)

    async def _let_policy_work(self, request: RunTrial.Goal) -> None:
        self._heard_at = self._good_at = time.monotonic()
        self._ended = Future()
        self._set_state(TrialState.RUNNING, "", request)
        try:
            await self._call(self._start_policy, Trigger.Request())
            if self._simulated and self._lockstep:
                await self._call(self._resume, Trigger.Request())
            why = await self._ended
            if not why:
                await self._samples_until_end()
        finally:
            self._ended = None
        if why:
            raise TrialError(why)

    async def _samples_until_end(self) -> None:
        """The last samples may still be on their way when the policy says that it is done."""
        log = self._log
        series: list[dict[int, Any]] = [log.place]
        by_stress = self._simulated or self._virtual
        series += [log.stress] if by_stress else [log.tool, log.width]
        until = time.monotonic() + LAST_SAMPLES
        while time.monotonic() < until:
            if min(max(samples, default=0) for samples in series) >= (log.end or 0):
                return
            await self.sleep(0.05)

    async def _finish(self, recording: bool, result: RunTrial.Result) -> None:
        """Stops everything that was started; a failure here must not hide the trial's."""
        steps: list[tuple[Any, Any]] = []
        if self._simulated and self._lockstep:
            steps.append((self._pause, Trigger.Request()))
        steps.append((self._stop_policy, Trigger.Request()))
        steps.append((self._enable, SetBool.Request(data=False)))
        if recording:
            await self.sleep(0.2)  # what was just published is on its way to the recorder
            steps.append((self._stop_recording, StopRecording.Request()))
        for client, request in steps:
            try:
                await self._call(client, request)
            except TrialError as error:
                self.get_logger().error(str(error))
                result.message += f"; {error}"

    async def _call(self, client: Any, request: Any, asks: int = 2) -> Any:
        """Calls a service; raises TrialError when it is absent, silent or says no."""
        name = client.srv_name
        await self._until_there(client)
        # A reply is lost when the server has not discovered the client's reader yet: ask twice.
        # Every service called here may be asked again; a recorder that has stopped says so.
        for _ in range(asks):
            response = await self._ask(client, request)
            if response is not None:
                break
        else:
            raise TrialError(
                f"service {name} did not answer within {asks} x {self._service_timeout} s: "
                "see that node's log, or raise service_timeout"
            )
        if not response.success:
            raise TrialError(f"{name}: {response.message}")
        return response

    async def _until_there(self, client: Any) -> None:
        """Raises TrialError when a service does not appear."""
        patience = self._startup_timeout
        while not client.service_is_ready():
            if patience <= 0.0:
                raise TrialError(
                    f"service {client.srv_name} is not there after {self._startup_timeout} s"
                )
            patience -= 0.1
            await self.sleep(0.1)

    async def _ask(self, client: Any, request: Any) -> Any:
        """The answer, or None after the service timeout."""
        future = client.call_async(request)
        timer = self.create_timer(self._service_timeout, future.cancel, clock=steady_clock())
        response = await future
        self.destroy_timer(timer)
        return response

    # --- the judgement

    def _metrics(self) -> TrialMetrics:
        start, end = self._log.start, self._log.end
        if start is None or end is None:
            raise TrialError("the policy never said when it started or ended")
        try:
            metrics = self._by_stress(start, end) if self._log.stress else self._by_pose(start, end)
        except ValueError as error:
            raise TrialError(f"no verdict: {error}") from error
        return TrialMetrics(**vars(metrics))

    def _by_stress(self, start: int, end: int) -> GraspMetrics:
        # As in codesign_report/bag.py: what was there at the start itself was published before the
        # recording began.
        stamps = sorted(s for s in self._log.stress if start < s <= end)
        samples = [self._log.stress[s] for s in stamps]
        pose_stamps = sorted(s for s in self._log.place if start < s <= end)
        times = (np.array(stamps) - start) * 1e-9
        return grasp_metrics(
            times,
            [s.top10_mean for s in samples],
            [s.median for s in samples],
            np.array([messages.from_xyz(s.left_force) for s in samples]),
            np.array([messages.from_xyz(s.right_force) for s in samples]),
            np.interp(
                times,
                (np.array(pose_stamps) - start) * 1e-9,
                [self._log.place[s][2] for s in pose_stamps],
            ),
        )

    def _by_pose(self, start: int, end: int) -> GraspMetrics:
        """A real arm: nobody knows the stress."""
        return pose_metrics(start, end, self._log.place, self._log.tool, self._log.width)

    def _set_state(self, state: int, message: str, request: RunTrial.Goal) -> None:
        self._state.state = state
        self._state.message = message
        self._state.gripper = request.gripper
        self._state.seed = request.seed
        if state == TrialState.PREPARING:
            self._state.elapsed = 0.0
            self._state.metrics = TrialMetrics()
            self._state.started = self._state.ended = stamp_of(0)
        self._publish_state()

    def _publish_state(self) -> None:
        self._state.header.stamp = self.get_clock().now().to_msg()
        self._state_pub.publish(self._state)

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        words = {0: "idle", 1: "preparing", 2: "running", 3: "finished", 4: "failed"}
        failed = self._state.state == TrialState.FAILED
        level = DiagnosticStatus.WARN if failed else DiagnosticStatus.OK
        values = {"seed": self._state.seed, "dry_run": self._dry_run}
        return level, self._state.message or words[self._state.state], values


def _position(message: PoseStamped) -> NDArray[np.float64]:
    return messages.from_xyz(message.pose.position)


def main() -> None:
    """Runs the node."""
    run(TrialRunner)
