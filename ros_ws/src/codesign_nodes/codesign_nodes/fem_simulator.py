"""Node fem_simulator: the simulated cell on the topics of a real arm.

At real time it ticks every 10 ms. With use_sim_time it is the clock: in lockstep it publishes a
tick's state, waits for the commands with that tick's stamp, and goes on at once, so that the same
seed gives the same trial bit for bit.

With follow_arm a real arm moves the fingers: the node listens to its driver, simulates the block
alone, and stamps what it publishes with the moment that the fingers are shown at.

Fingers that come on /finger_design are put on at the next reset, never in the middle of a trial.
"""

import time
from typing import Any

import numpy as np
from codesign_interfaces.msg import (
    FingerDesign,
    GripperCommand,
    GripperState,
    JointCommand,
    SimulationState,
    SoftBodyMesh,
    Stress,
)
from codesign_interfaces.srv import ResetSimulation
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from codesign_control.setpoint_buffer import SetpointBuffer
from codesign_design.finger_pair import FingerPair
from codesign_design.stock import stock_fingers
from codesign_nodes import messages, qos
from codesign_nodes.followed_arm import FollowedArm
from codesign_nodes.markers import SceneMarkers
from codesign_nodes.node_tools import (
    Diagnostics,
    LeanNode,
    declare,
    nanoseconds,
    run,
    seconds,
    stamp_of,
    steady_clock,
)
from codesign_nodes.simulated_cell import CellConfig, SimulatedCell
from codesign_policy.domain import TrialDomain, draw_domain

TICK_NS = 10_000_000  # 100 Hz: joint states
SLOW_TICKS = 5  # 20 Hz: gripper state, object pose, stress, shape; the policy's grid
MARKER_TICKS = 10  # 10 Hz
MAX_CATCH_UP = 5  # ticks that a late timer makes up for
CLOCK_JUMP_NS = 200_000_000  # between the clock and the even grid of ticks


class FemSimulator(LeanNode):
    """Publishes what a real arm would, and the ground truth that only a simulator has."""

    def __init__(self) -> None:
        super().__init__("fem_simulator")
        seed = declare(
            self, "seed", 0, "seed of the first block's material and place", low=0, high=2**53
        )
        self._lockstep = self.get_parameter("use_sim_time").value
        config = CellConfig(
            tetrahedra=declare(self, "tetrahedra", 2400, "resolution of the block: 600 or 2400"),
            object_mesh=declare(
                self, "object_mesh", "", "tetrahedral mesh file to simulate instead of the block"
            ),
            object_scale=declare(
                self, "object_scale", 1.0, "metres per unit of object_mesh", low=1e-6, high=1e3
            ),
            table_height=declare(
                self, "table_height", 0.0, "z of the table in link_base [m]", low=-0.5, high=0.5
            ),
            open_width=declare(
                self, "open_width", 0.06, "gap after a reset [m]", low=0.035, high=0.084
            ),
            arm_lag=declare(
                self,
                "arm_lag",
                0.010,
                "time constant of each of the arm's two lags [s]",
                low=0.001,
                high=0.2,
            ),
            gripper_speed=declare(
                self, "gripper_speed", 0.1, "default speed of the gap [m/s]", low=0.015, high=0.225
            ),
        )
        self._delay = declare(
            self,
            "command_delay",
            0.050,
            "real time: age at which the simulated arm carries out a set-point, as the buffer of a "
            "real one; jitter up to that stays out of the motion [s]",
            low=0.0,
            high=0.2,
        )
        self._arm = self._declare_arm()
        self._publishes_design = declare(
            self,
            "publish_design",
            True,
            "publish the stock fingers on /finger_design; false where finger_design does, and then "
            "~/reset is offered once fingers have come",
        )
        self._object_topic = declare(
            self,
            "object_pose_topic",
            "/object_pose",
            "where the block's true pose goes; another one where a camera finds /object_pose",
        )
        self._republish_after = declare(
            self,
            "republish_after",
            0.1,
            "lockstep: wall time of waiting until the state is sent again [s]",
            low=0.02,
            high=10.0,
        )
        self._cell = SimulatedCell(config, stock_fingers())
        self._next_fingers: FingerPair | None = None
        self._designs_refused, self._design_error = 0, ""
        self._markers = self._scene_markers()
        self._tick = 0
        self._paused = False
        self._rejected = 0
        self._overruns = 0
        self._busy = 0.0
        self._report_at = time.monotonic()
        self._report_tick = 0
        self._setpoints = SetpointBuffer()
        self._started_at, self._started_ns = time.monotonic(), 0
        self._ticks_done = 0
        self._moment = 0  # of a followed arm, that the fingers are shown at [ns]
        self._no_block, self._missing = "", ""
        self._behind = False
        self._error = ""
        self._commands: dict[str, int] = {}
        self._sent_at = 0.0
        # May compile kernels first; nobody is to wait for an answer meanwhile.
        self._domain = domain = draw_domain(seed)
        self._cell.reset(domain)
        if self._arm is not None:
            self._no_block = "waiting for the arm and its fingers"
        self._make_interfaces()
        self._publish_mesh(domain)
        self._knows_fingers = self._publishes_design
        if self._publishes_design:
            self._publish_design()
            self._offer_reset()
        if self._lockstep:
            self._timer = self.create_timer(0.05, self._republish, clock=steady_clock())
            self._publish_state()
        else:
            self._started_at = time.monotonic()
            self._started_ns = self.get_clock().now().nanoseconds
            self._timer = self.create_timer(TICK_NS * 1e-9, self._on_timer, clock=steady_clock())
        self._diagnostics = Diagnostics(self, self._report)

    def _declare_arm(self) -> FollowedArm | None:
        """The real arm whose fingers touch the block, if that is asked for."""
        follows = declare(
            self,
            "follow_arm",
            False,
            "real time: arm and gripper are real ones, the fingers are where /joint_states and "
            "/gripper_state say; neither is simulated or published",
        )
        self._follow_delay = declare(
            self,
            "follow_delay",
            0.06,
            "follow_arm: age at which the arm's reports count, so that their jitter and the 50 ms "
            "between two of the gripper stay out of the motion [s]",
            low=0.0,
            high=0.3,
        )
        if follows and self._lockstep:
            raise ValueError("follow_arm: a real arm has no simulated time, leave out use_sim_time")
        return FollowedArm() if follows else None

    def _make_interfaces(self) -> None:
        offered = qos.STATE_OFFERED
        self._clock_pub = (
            self.create_publisher(Clock, "/clock", offered) if self._lockstep else None
        )
        self._pose_pub = self.create_publisher(PoseStamped, self._object_topic, qos.POSE_OFFERED)
        self._stress_pub = self.create_publisher(Stress, "/stress", offered)
        self._state_pub = self.create_publisher(SimulationState, "/simulation_state", offered)
        self._mesh_pub = self.create_publisher(SoftBodyMesh, "/soft_body_mesh", qos.LATCHED)
        self._marker_pub = self.create_publisher(MarkerArray, "/markers", 2)
        if self._arm is None:
            self._make_arm_interfaces()
        else:
            self.create_subscription(JointState, "/joint_states", self._on_joints, qos.STATE)
            self.create_subscription(GripperState, "/gripper_state", self._on_gripper, qos.STATE)
        self.create_subscription(FingerDesign, "/finger_design", self._on_design, qos.LATCHED)
        self._reset_service: Any = None
        self.create_service(Trigger, "~/pause", self._on_pause)
        self.create_service(
            Trigger, "~/resume", self._on_resume, callback_group=ReentrantCallbackGroup()
        )

    def _make_arm_interfaces(self) -> None:
        """Those of a driver, in the place of a real one."""
        offered = qos.STATE_OFFERED
        self._joint_pub = self.create_publisher(JointState, "/joint_states", offered)
        self._gripper_pub = self.create_publisher(GripperState, "/gripper_state", offered)
        self.create_subscription(
            JointCommand, "/joint_command", self._on_joint_command, qos.JOINT_COMMAND_REQUESTED
        )
        self.create_subscription(
            GripperCommand,
            "/gripper_command",
            self._on_gripper_command,
            qos.GRIPPER_COMMAND_REQUESTED,
        )

    def _offer_reset(self) -> None:
        """A trial begins with a reset, so none begins before the fingers are known, nor before a
        real arm was heard of."""
        known = self._arm is None or self._arm.heard
        if self._reset_service is None and known:
            self._reset_service = self.create_service(ResetSimulation, "~/reset", self._on_reset)

    # --- time

    def _stamp(self) -> Any:
        if self._lockstep:
            return stamp_of(self._tick * TICK_NS)
        if self._arm is not None:
            return stamp_of(self._moment)
        return self.get_clock().now().to_msg()

    def _on_timer(self) -> None:
        """Real time: as many ticks as have come due, so that a late timer costs no time."""
        due = int((time.monotonic() - self._started_at) / (TICK_NS * 1e-9)) - self._ticks_done
        if due > MAX_CATCH_UP:  # too slow for real time: the rest is given up, and reported
            self._ticks_done += due - MAX_CATCH_UP
            due = MAX_CATCH_UP
        for _ in range(due):
            self._ticks_done += 1
            if self._arm is not None:
                self._follow_arm(self._arm)
            elif not self._error:
                self._follow_setpoints(self._started_ns + self._ticks_done * TICK_NS)
                self._advance()

    def _follow_setpoints(self, now_ns: int) -> None:
        position = self._setpoints.at(now_ns * 1e-9 - self._delay)
        if position is not None:
            self._cell.command_joints(position)

    def _follow_arm(self, arm: FollowedArm) -> None:
        """The fingers go where the real ones were; while that is not known they stand still."""
        self._moment = self._on_grid() - round(self._follow_delay * 1e9)
        self._missing = arm.missing(time.monotonic())
        if self._no_block:
            self._put_first_block()
        elif not self._error:
            if self._missing:
                self._cell.stand_still()
            else:
                self._cell.follow(*arm.at(self._moment * 1e-9))
            self._advance()
            self._behind |= self._cell.behind

    def _on_grid(self) -> int:
        """The moment of this tick on an even grid [ns]; a jump of the clock moves the grid."""
        now = self.get_clock().now().nanoseconds
        on_grid = self._started_ns + self._ticks_done * TICK_NS
        if abs(on_grid - now) > CLOCK_JUMP_NS:
            self._started_ns += now - on_grid
            return now
        return on_grid

    def _put_first_block(self) -> None:
        """Puts a block down as soon as arm and fingers are known and leave it room."""
        if self._knows_fingers:
            self._offer_reset()
        if self._missing or self._reset_service is None:
            return
        try:
            self._reset(self._domain)
        except ValueError as error:
            self._no_block = str(error)

    def _advance_if_ready(self) -> None:
        """Lockstep: goes on once both commands of this tick are there."""
        needed = {"arm", "gripper"} if self._tick % SLOW_TICKS == 0 else {"arm"}
        now = self._tick * TICK_NS
        there = {name for name, stamp in self._commands.items() if stamp == now}
        if needed <= there and not self._paused and not self._error:
            self._commands.clear()
            self._advance()

    def _advance(self) -> None:
        started = time.monotonic()
        try:
            self._cell.tick(TICK_NS * 1e-9)
        except Exception as error:  # the state is no longer to be trusted until a reset
            self._error = f"{type(error).__name__}: {error}"
            self.get_logger().error(f"simulation stopped, call ~/reset: {self._error}")
            return
        self._tick += 1
        self._publish_state()
        elapsed = time.monotonic() - started
        self._busy += elapsed
        self._overruns += elapsed > TICK_NS * 1e-9

    def _republish(self) -> None:
        """Lockstep: a lost message must not stop the world."""
        if time.monotonic() - self._sent_at > self._republish_after:
            self._publish_state()

    # --- output

    def _publish_state(self) -> None:
        self._sent_at = time.monotonic()
        stamp = self._stamp()
        if self._clock_pub is not None:
            self._clock_pub.publish(Clock(clock=stamp))
        # The block and the gripper first: who acts on the joint state finds the rest there.
        if self._tick % SLOW_TICKS == 0:
            self._publish_truth(stamp)
            self._publish_object_pose(stamp)
            if self._arm is None:
                self._publish_gripper(stamp)
        if self._arm is None:
            self._publish_joints(stamp)
        if self._tick % MARKER_TICKS == 0:
            self._publish_markers()

    def _publish_joints(self, stamp: Any) -> None:
        message = JointState(
            name=[f"joint{k + 1}" for k in range(7)],
            position=self._cell.joint_position.tolist(),
            velocity=self._cell.joint_velocity.tolist(),
        )
        message.header.stamp = stamp
        self._joint_pub.publish(message)

    def _publish_gripper(self, stamp: Any) -> None:
        gripper = self._cell.gripper
        message = GripperState(
            width=gripper.width,
            velocity=self._cell.gripper_velocity,
            target_width=self._cell.width_command,
            drive_joint=gripper.drive_joint(gripper.width),
            moving=abs(self._cell.gripper_velocity) > 1e-6,
        )
        message.header.stamp = stamp
        self._gripper_pub.publish(message)

    def _publish_object_pose(self, stamp: Any) -> None:
        position, quaternion = self._cell.simulator.object_pose()
        message = PoseStamped(pose=messages.pose(position[0], quaternion[0]))
        message.header.stamp = stamp
        message.header.frame_id = "link_base"
        self._pose_pub.publish(message)

    def _publish_truth(self, stamp: Any) -> None:
        simulator = self._cell.simulator
        stress, contact = simulator.stress(), simulator.contact()
        message = Stress(
            measure=Stress.COROTATED,
            top10_mean=float(stress.top10_mean[0]),
            mean=float(stress.mean[0]),
            median=float(stress.median[0]),
            von_mises=messages.floats(stress.von_mises[0]),
            left_force=messages.vector3(contact.left[0]),
            right_force=messages.vector3(contact.right[0]),
            table_force=messages.vector3(contact.table[0]),
            finger_penetration=float(contact.finger_penetration[0]),
            table_penetration=float(contact.table_penetration[0]),
        )
        message.header.stamp = stamp
        message.header.frame_id = "link_base"
        self._stress_pub.publish(message)
        left, right = self._finger_poses()
        state = SimulationState(
            positions=messages.floats(simulator.positions[0]), left_finger=left, right_finger=right
        )
        state.header = message.header
        self._state_pub.publish(state)

    def _finger_poses(self) -> tuple[Any, Any]:
        from scipy.spatial.transform import Rotation

        position, quaternion = self._cell.grasp_pose()
        opening = Rotation.from_quat(quaternion).apply([0.0, self._cell.gripper.width / 2.0, 0.0])
        return (
            messages.pose(position + opening, quaternion),
            messages.pose(position - opening, quaternion),
        )

    def _publish_markers(self) -> None:
        if self._marker_pub.get_subscription_count() == 0:
            return
        simulator = self._cell.simulator
        stress = simulator.stress().von_mises[0]
        self._marker_pub.publish(
            self._markers.serialized(simulator.positions[0], stress, *self._finger_poses())
        )

    def _scene_markers(self) -> SceneMarkers:
        cell = self._cell
        return SceneMarkers(
            cell.simulator.surface_triangles,
            cell.simulator.surface_tetrahedra,
            cell.fingers,
            cell.config.table_height,
        )

    def _publish_mesh(self, domain: TrialDomain) -> None:
        simulator = self._cell.simulator
        message = SoftBodyMesh(
            rest_positions=messages.floats(simulator.rest_positions),
            tetrahedra=messages.indices(simulator.tetrahedra),
            surface_triangles=messages.indices(simulator.surface_triangles),
            surface_tetrahedra=messages.indices(simulator.surface_tetrahedra),
            domain=messages.domain_message(domain),
        )
        message.header.stamp = self._stamp()
        message.header.frame_id = "tofu"
        self._mesh_pub.publish(message)

    def _publish_design(self) -> None:
        self._design_pub = self.create_publisher(FingerDesign, "/finger_design", qos.LATCHED)
        message = messages.design_message(self._cell.fingers)
        message.header.stamp = self._stamp()
        self._design_pub.publish(message)

    # --- input

    def _is_old(self, message: Any) -> bool:
        """Lockstep: an answer to another tick, which was still on its way at a reset."""
        return self._lockstep and nanoseconds(message.header.stamp) != self._tick * TICK_NS

    def _on_joint_command(self, message: JointCommand) -> None:
        if self._is_old(message):
            return
        try:
            if self._lockstep:
                self._cell.command_joints(np.array(message.position))
            else:
                self._setpoints.add(seconds(message.valid_at), np.array(message.position))
        except ValueError as error:
            self._reject(error)
            return
        if self._lockstep:
            self._commands["arm"] = nanoseconds(message.header.stamp)
            self._advance_if_ready()

    def _on_gripper_command(self, message: GripperCommand) -> None:
        if self._is_old(message):
            return
        try:
            self._cell.command_width(message.width, message.speed)
        except ValueError as error:
            self._reject(error)
            return
        if self._lockstep:
            self._commands["gripper"] = nanoseconds(message.header.stamp)
            self._advance_if_ready()

    def _on_joints(self, message: JointState) -> None:
        """Of a real arm."""
        assert self._arm is not None
        moment = seconds(message.header.stamp)
        try:
            self._arm.add_joints(moment, message.position[:7], time.monotonic())
        except ValueError as error:
            self._reject(error)

    def _on_gripper(self, message: GripperState) -> None:
        """Of a real gripper."""
        assert self._arm is not None
        try:
            self._arm.add_width(seconds(message.header.stamp), message.width, time.monotonic())
        except ValueError as error:
            self._reject(error)

    def _reject(self, error: ValueError) -> None:
        self._rejected += 1
        self.get_logger().warning(f"rejected: {error}", throttle_duration_sec=1.0)

    def _on_design(self, message: FingerDesign) -> None:
        """Checks fingers and keeps them until the next reset; bad ones change nothing."""
        try:
            fingers = messages.design_from(message)
            self._cell.check_fingers(fingers)
        except ValueError as error:
            self._designs_refused += 1
            self._design_error = f"/finger_design refused: {error}"
            self.get_logger().error(self._design_error)
            return
        self._design_error = ""
        worn = fingers.content_hash == self._cell.fingers.content_hash
        self._next_fingers = None if worn else fingers
        self._knows_fingers = True
        self._offer_reset()

    def _change_fingers(self) -> None:
        if self._next_fingers is None:
            return
        fingers, self._next_fingers = self._next_fingers, None
        self._cell.set_fingers(fingers)
        self._markers = self._scene_markers()
        self.get_logger().info(f"fingers {fingers.name} ({fingers.content_hash[:12]})")

    # --- services

    def _on_reset(
        self, request: ResetSimulation.Request, response: ResetSimulation.Response
    ) -> ResetSimulation.Response:
        try:
            domain = draw_domain(int(request.seed), messages.domain_from(request.domain))
            self._reset(domain)
        except ValueError as error:
            response.success, response.message = False, str(error)
            return response
        self._paused = bool(request.paused) and self._lockstep
        response.success, response.domain = True, messages.domain_message(domain)
        arm = "in its start posture" if self._arm is None else "as it is"
        response.message = f"block on the table, arm {arm}"
        response.fingers = self._cell.fingers.content_hash
        self._publish_state()
        return response

    def _reset(self, domain: TrialDomain) -> None:
        if self._arm is None:
            self._change_fingers()
            self._cell.reset(domain)
        else:
            self._reset_under(self._arm, domain)
        self._error = ""
        self._commands.clear()
        self._setpoints.clear()
        # Time never stands still between trials, and the next one begins on a stress tick, so
        # that what is published when does not depend on how long the last one took.
        self._tick = (self._tick // MARKER_TICKS + 1) * MARKER_TICKS
        self._publish_mesh(domain)

    def _reset_under(self, arm: FollowedArm, domain: TrialDomain) -> None:
        """A new block under a real arm, which does not move.

        Raises:
            ValueError: where the fingers are is not known, or they are in the way; nothing changed.
        """
        missing = arm.missing(time.monotonic())
        if missing:
            raise ValueError(f"{missing}: where the fingers are is not known")
        joints, width = arm.at(self._moment * 1e-9)
        self._cell.require_room(domain, joints, width, self._next_fingers or self._cell.fingers)
        self._change_fingers()
        self._cell.stand(joints, width)
        self._cell.place_block(domain)
        self._no_block = ""

    def _on_pause(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._paused = True
        response.success = True
        return response

    async def _on_resume(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        await self.until_heard()
        self._paused = False
        response.success = not self._error
        response.message = self._error
        if self._lockstep:
            self._advance_if_ready()
        return response

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        now = time.monotonic()
        simulated = (self._tick - self._report_tick) * TICK_NS * 1e-9
        values = {
            "real_time_factor": round(simulated / max(now - self._report_at, 1e-9), 3),
            "busy_share": round(self._busy / max(now - self._report_at, 1e-9), 3),
            "overruns": self._overruns,
            "commands_rejected": self._rejected,
            "paused": self._paused,
            "fingers": _label(self._cell.fingers),
            "next_fingers": _label(self._next_fingers) if self._next_fingers else "",
            "designs_refused": self._designs_refused,
        }
        behind, self._behind = self._behind, False
        self._busy, self._report_at, self._report_tick = 0.0, now, self._tick
        if self._error:
            return DiagnosticStatus.ERROR, self._error, values
        if self._missing:
            return DiagnosticStatus.ERROR, f"the fingers stand still: {self._missing}", values
        if self._no_block:
            return DiagnosticStatus.WARN, f"no block yet: {self._no_block}", values
        if self._design_error:
            return DiagnosticStatus.WARN, self._design_error, values
        if self._reset_service is None:
            return DiagnosticStatus.WARN, "waiting for /finger_design", values
        if behind:
            return DiagnosticStatus.WARN, "the fingers catch up with the arm's reports", values
        waiting = self._lockstep and not self._paused and now - self._sent_at > 1.0
        if waiting:
            return DiagnosticStatus.WARN, "waiting for /joint_command and /gripper_command", values
        return DiagnosticStatus.OK, "running", values


def _label(fingers: FingerPair) -> str:
    return f"{fingers.name} {fingers.content_hash[:12]}"


def main() -> None:
    """Runs the node."""
    run(FemSimulator)
