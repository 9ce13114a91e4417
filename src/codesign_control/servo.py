"""The Cartesian servo: action deltas in, joint set-points that keep every limit out.

Pure: no clock, no thread, no ROS. The caller passes the time of a steady clock in seconds and
calls `step` once per control period.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum, IntEnum

import numpy as np
import pinocchio as pin

from codesign_control.config import ServoConfig
from codesign_control.hand import Hand
from codesign_control.motion import (
    DOF,
    JointMotion,
    JointState,
    Limit,
    TrajectoryError,
)
from codesign_control.pose import Pose, bounded, difference, finite_vector
from codesign_control.reference import Reference
from codesign_control.xarm7 import IkError, Xarm7

SETTLED = 1e-9  # m, rad: a smaller error of the held pose is left alone
SPEED_RESERVE = 0.95  # of the joint velocity limit is asked for; the rest absorbs overshoot
LOOK_AHEAD = 1e-4  # s, step of the numeric derivative of the smallest singular value
SLOWED = 0.99  # a scale below this counts as a limit at work
PROJECTIONS = 8  # pairs of links, one after the other, whose approach is taken out
GRIPPER_STEPS = (1.0, 0.5, 0.25, 0.1)  # parts of the way to the asked gap that are tried


class ServoState(IntEnum):
    """Numbered as in ControllerStatus.msg."""

    DISABLED = 0
    READY = 1  # enabled, holding still
    MOVING = 2  # following actions or a move_to goal
    HALTED = 3  # braked because actions went stale; a fresh action goes on
    FAULT = 4  # latched until reset_fault


class GoalState(Enum):
    """What became of the last `move_to`."""

    NONE = "none"
    RUNNING = "running"
    REACHED = "reached"
    CANCELLED = "cancelled"
    ABORTED = "aborted"


class ActionRejected(ValueError):
    """An action that will not be carried out; the message names the value and the limit."""


class MoveRejected(ValueError):
    """A request (enable, move_to, reset_fault) that is refused; the arm's motion is unchanged."""


@dataclass(frozen=True)
class ServoCounters:
    actions_accepted: int = 0
    actions_rejected: int = 0
    halts: int = 0  # watchdog stops
    faults: int = 0
    brakes: int = 0  # ticks in which the asked motion was unsafe and the arm braked instead
    gripper_waits: int = 0  # ticks in which the gripper waited: its fingers would meet the table


@dataclass(frozen=True)
class ServoOutput:
    """One set-point and the servo's condition.

    active: whether the set-point is to be sent to the arm (enabled, or still braking). While it is
    False, `position` is the last measured posture.
    """

    position: np.ndarray  # (7,) rad
    velocity: np.ndarray  # (7,) rad/s
    acceleration: np.ndarray  # (7,) rad/s^2
    active: bool
    state: ServoState
    message: str
    gripper: float | None  # m, the gap to go to now; None before one was asked for
    limits: Limit  # what slowed or stopped the motion in this tick
    singularity_scale: float  # 1: full speed; towards 0 near a singularity
    tracking_error: float  # rad, largest |commanded - measured|; NaN without a measurement
    goal: GoalState
    goal_remaining: float  # rad, largest joint distance to the move_to goal; 0 without one
    counters: ServoCounters


@dataclass(frozen=True)
class Proximity:
    """What the arm is near to, at the last set-point."""

    self_distance: float  # m, least distance of two links that could meet
    links: tuple[str, str]  # the two
    table_room: float  # m, how much lower the hand or a link could go


class CartesianServo:
    """Follows Cartesian action deltas of `link_tcp`, or moves to a goal in joint space.

    All times are seconds of one steady clock. Serves one thread.
    """

    def __init__(
        self, arm: Xarm7, config: ServoConfig | None = None, hand: Hand | None = None
    ) -> None:
        self.arm = arm
        self.config = config or ServoConfig()
        self.counters = ServoCounters()
        self.state = ServoState.DISABLED
        self.message = "not enabled"
        self.limit_ticks = {limit.name: 0 for limit in Limit if limit.name}  # since the start
        self._motion = JointMotion(arm, self.config, arm.home, hand)
        self._limits = Limit.NONE
        self._gripper_asked: float | None = None
        self._gripper: float | None = None  # what is allowed of it
        self._gripper_measured: float | None = None
        # What was allowed in the last ticks, as far back as targets may be on their way.
        ticks = math.ceil(self.config.gripper_delay / self.config.period)
        self._gripper_sent: deque[float] = deque(maxlen=1 + ticks)
        self._reference = Reference(self.config, arm.tcp_placement(arm.home))
        self._goal_state = GoalState.NONE
        self._goal_path: list[JointState] = []
        self._action_time = -math.inf
        self._measured: np.ndarray | None = None
        self._measured_time = -math.inf
        self._tracking_error = math.nan
        self._singularity_scale = 1.0

    # Requests ------------------------------------------------------------------------------------

    def enable(self, measured_q: Sequence[float] | np.ndarray, now: float) -> None:
        """DISABLED -> READY, holding the measured posture: the first set-point equals it.

        Raises MoveRejected when in another state, still braking, or when the posture lies outside
        the joint limits or the workspace box, or too near to the arm itself or the table.
        """
        if self.state is not ServoState.DISABLED:
            raise MoveRejected(f"enable: state is {self.state.name}, expected DISABLED")
        if not self._motion.state.at_rest:
            raise MoveRejected("enable: still braking")
        measured = self._checked_posture("measured posture", measured_q)
        self._motion.stand(measured)
        self._measured, self._measured_time = measured, now
        self._gripper = self._gripper_asked = self._gripper_measured
        self._hold(ServoState.READY, "holding")
        self._goal_state = GoalState.NONE

    def disable(self) -> None:
        """Any state but FAULT -> DISABLED; a moving arm brakes first (`active` stays True)."""
        if self.state is ServoState.FAULT:
            return
        self._end_goal(GoalState.CANCELLED)
        self._hold(ServoState.DISABLED, "disabled")

    def fault(self, message: str) -> None:
        """Any state -> FAULT, braking: for errors that the caller sees, such as the arm's own."""
        if self.state is ServoState.FAULT:
            return
        self._end_goal(GoalState.ABORTED)
        self._count(faults=1)
        self._hold(ServoState.FAULT, message)

    def reset_fault(self, measured_q: Sequence[float] | np.ndarray, now: float) -> None:
        """FAULT -> DISABLED; the motion state starts again from the measured posture.

        Raises MoveRejected when in another state, still braking, or when `measured_q` is not a
        finite (7,) vector. Enabling stays an explicit step of its own.
        """
        if self.state is not ServoState.FAULT:
            raise MoveRejected(f"reset_fault: state is {self.state.name}, expected FAULT")
        if not self._motion.state.at_rest:
            raise MoveRejected("reset_fault: still braking")
        try:
            measured = finite_vector("measured posture", measured_q, DOF)
        except ValueError as error:
            raise MoveRejected(f"reset_fault: {error}") from error
        self._measured, self._measured_time = measured, now
        self._motion.stand(measured)
        self._hold(ServoState.DISABLED, "fault reset, not enabled")

    def set_hand(self, hand: Hand) -> None:
        """The gripper carries other fingers. MoveRejected unless DISABLED or FAULT, standing."""
        if self.state not in (ServoState.DISABLED, ServoState.FAULT):
            raise MoveRejected(f"set_hand: state is {self.state.name}, expected DISABLED")
        if not self._motion.state.at_rest:
            raise MoveRejected("set_hand: still braking")
        self._motion.set_hand(hand)
        self._gripper = self._gripper_asked = self._gripper_measured = None
        self._gripper_sent.clear()

    def observe_gripper(self, width: float) -> None:
        """The measured gap [m]. Until the first one the fingers are taken to be anywhere."""
        if math.isfinite(width):
            self._gripper_measured = width
            self._spread_fingers()

    def ask_gripper(self, width: float) -> None:
        """Asks for a gap [m]: `ServoOutput.gripper` goes there as far as the table lets it.

        While the gripper closes its fingers move forward by up to 12 mm, which the arm has to make
        room for. ValueError when not finite.
        """
        if not math.isfinite(width):
            raise ValueError(f"gripper: gap {width} m, must be finite")
        self._gripper_asked = width

    @property
    def gripper_asked(self) -> float | None:
        """The gap that was asked for [m], or measured when enabled; None before."""
        return self._gripper_asked

    def submit(
        self,
        translation: Sequence[float] | np.ndarray,
        rotation: Sequence[float] | np.ndarray,
        now: float,
    ) -> None:
        """Adds one action to the reference: displacement of `link_tcp` in `link_base` axes.

        translation: (3,) m. rotation: (3,) rotation vector [rad]. Zeros hold.
        Raises ActionRejected, and counts, when the servo takes no actions now or the values have a
        wrong length, are not finite or exceed the limit of one action.
        """
        try:
            delta = self._checked_action(translation, rotation)
        except ValueError as error:
            self._count(actions_rejected=1)
            raise ActionRejected(str(error)) from error
        self._count(actions_accepted=1)
        self._action_time = now
        self._reference.push(delta)
        self.state, self.message = ServoState.MOVING, "following actions"

    def move_to(
        self,
        goal: Pose | Sequence[float] | np.ndarray,
        now: float,
        speed_scale: float = 0.3,
    ) -> None:
        """Starts a jerk-limited motion in joint space to a posture (7,) rad or a pose of the TCP.

        speed_scale: (0, 1] of the joint velocity limit. Follow it by `ServoOutput.goal`; actions
        are rejected while it runs. Raises MoveRejected when the arm is not enabled and standing,
        or the goal or the way to it is outside the limits or the workspace box.
        """
        if self.state not in (ServoState.READY, ServoState.MOVING, ServoState.HALTED):
            raise MoveRejected(f"move_to: state is {self.state.name}, not enabled")
        if not self._motion.state.at_rest:
            raise MoveRejected("move_to: the arm is moving")
        if not 0.0 < speed_scale <= 1.0:
            raise MoveRejected(f"move_to: speed_scale {speed_scale}, expected (0, 1]")
        try:
            here = self._motion.state.position
            joints = self.arm.ik(goal, here) if isinstance(goal, Pose) else goal
            path = self._motion.plan(self._checked_posture("goal", joints), speed_scale)
        except (IkError, TrajectoryError, ValueError) as error:
            raise MoveRejected(f"move_to: {error}") from error
        self._goal_path = path
        self._goal_state = GoalState.RUNNING
        self.state, self.message = ServoState.MOVING, "moving to a goal"

    def cancel(self) -> None:
        """Ends a running `move_to`: the arm brakes and is READY. Without one: no effect."""
        if self._goal_state is GoalState.RUNNING:
            self._end_goal(GoalState.CANCELLED)
            self._hold(ServoState.READY, "goal cancelled")

    # The control step ----------------------------------------------------------------------------

    def step(self, measured_q: Sequence[float] | np.ndarray | None, now: float) -> ServoOutput:
        """The set-point of the coming period. Call it once per `ServoConfig.period`.

        measured_q: (7,) rad, only for the tracking check; None when there is none newer than at
        the last call. Never raises on bad values: they end in a FAULT, braking.
        """
        self._observe(measured_q, now)
        self._limits = Limit.NONE
        braking = not self._motion.state.at_rest  # the last set-point of a stop is still sent
        following = self.state is ServoState.MOVING and self._goal_state is not GoalState.RUNNING
        # Written so that NaN and a clock that went backwards count as stale too.
        if following and not 0.0 <= now - self._action_time <= self.config.action_timeout:
            self._count(halts=1)
            self._hold(ServoState.HALTED, "halted: no fresh action")
        self._move_gripper()
        try:
            self._move()
        except (TrajectoryError, np.linalg.LinAlgError) as error:
            self._motion.brake()
            self.fault(str(error))
        for limit in self._limits:
            self.limit_ticks[str(limit.name)] += 1
        return self._output(braking)

    def proximity(self) -> Proximity:
        """What the arm is near to; computed when asked."""
        room, own = self._motion.room(), self._motion.clearance.self_pairs
        nearest = int(room[:own].argmin())
        tcp = self.arm.tcp_placement(self._motion.state.position)
        below, _ = self._motion.hand_height.rooms(tcp)
        return Proximity(
            self_distance=float(room[nearest]) + self.config.self_collision_margin,
            links=self._motion.clearance.names[nearest],
            table_room=float(min(room[own:].min(), below.min())),
        )

    @property
    def commanded_pose(self) -> Pose:
        """Pose of `link_tcp` at the last set-point."""
        return self.arm.fk_tcp(self._motion.state.position)

    @property
    def reference_pose(self) -> Pose:
        """Where the accepted actions lead: the commanded pose's end when no more actions come."""
        return Pose.from_se3(self._reference.target)

    # Inside --------------------------------------------------------------------------------------

    def _move(self) -> None:
        if self.state is not ServoState.MOVING:
            self._motion.brake()
        elif self._goal_state is GoalState.RUNNING:
            self._follow_goal()
        else:
            self._follow_reference()

    def _move_gripper(self) -> None:
        """Lets the gripper go towards the asked gap, where its fingers stay off the table."""
        goal = self._gripper_asked
        if goal is None:
            return
        if goal != self._gripper:
            self._gripper = self._allowed_gap(goal)
        if self._gripper is not None:
            self._gripper_sent.append(self._gripper)
            self._spread_fingers()
        if self._gripper != goal:
            self._limits |= Limit.TABLE
            self._count(gripper_waits=1)

    def _allowed_gap(self, goal: float) -> float | None:
        """As far towards `goal` [m] as the table lets the gripper go, or where it is now."""
        start = goal if self._gripper is None else self._gripper
        for part in GRIPPER_STEPS:
            width = goal if part == 1.0 else start + part * (goal - start)
            if self._motion.allows_widths(self._finger_range(width)):
                return width
        return self._gripper

    def _finger_range(self, target: float | None) -> tuple[float, float]:
        """Between these gaps [m] the fingers may be while the gripper goes to `target`.

        What was taken back within the gripper's delay is still carried out for a moment.
        """
        ends = (self._gripper_measured, target, *self._gripper_sent)
        known = [width for width in ends if width is not None]
        return (min(known), max(known))

    def _spread_fingers(self) -> None:
        self._motion.hand_height.set_widths(self._finger_range(self._gripper))

    def _follow_goal(self) -> None:
        if not self._motion.follow(self._goal_path.pop(0)):
            self._limits |= self._motion.refused
            self._end_goal(GoalState.ABORTED)
            self._hold(ServoState.READY, "goal aborted: a limit was in the way")
        elif not self._goal_path:
            self._end_goal(GoalState.REACHED)
            self._hold(ServoState.READY, "goal reached")

    def _follow_reference(self) -> None:
        config, q = self.config, self._motion.state.position
        commanded = self.arm.tcp_placement(q)
        error = difference(commanded, self._reference.pose)
        on_leash = bounded(error, config.leash, config.leash_rotation)
        if (on_leash != error).any():
            self._reference.drag(commanded)
        feed_forward = self._reference.advance() / config.period
        twist = feed_forward + config.gain * error
        if np.abs(twist).max() < SETTLED:
            twist = np.zeros(6)
        twist = bounded(twist, config.linear_speed, config.angular_speed)
        twist = self._inside_box(self._above_table(twist, commanded), commanded)
        if not self._motion.follow_velocity(self._joint_velocity(q, twist)):
            self._limits |= self._motion.refused
            self._count(brakes=1)

    def _above_table(self, twist: np.ndarray, commanded: pin.SE3) -> np.ndarray:
        """(6,) twist, raised where a point of the hand would approach the table too fast."""
        rooms, offsets = self._motion.hand_height.rooms(commanded)
        turning = twist[3] * offsets[:, 1] - twist[4] * offsets[:, 0]  # z of w x r
        slowest = -self.config.limit_gain * (rooms - self.config.finger_margin) - turning
        lowest = float(slowest.max())
        if lowest > twist[2]:
            twist = twist.copy()
            twist[2] = min(lowest, self.config.linear_speed)
            self._limits |= Limit.TABLE
        return twist

    def _inside_box(self, twist: np.ndarray, commanded: pin.SE3) -> np.ndarray:
        """(6,) twist, slowed towards the sides of the workspace box."""
        gain = self.config.limit_gain
        to_lower = np.subtract(self.config.box_lower, commanded.translation)
        to_upper = np.subtract(self.config.box_upper, commanded.translation)
        inside = np.clip(twist[:3], gain * to_lower, gain * to_upper)
        if (inside != twist[:3]).any():
            self._limits |= Limit.BOX
        return np.concatenate([inside, twist[3:]])

    def _joint_velocity(self, q: np.ndarray, twist: np.ndarray) -> np.ndarray:
        """(7,) rad/s that move the TCP with a (6,) twist, slowed where a limit is near."""
        config = self.config
        jacobian = self.arm.jacobian_tcp(q)
        left, singular, right = np.linalg.svd(jacobian)
        nearness = max(0.0, 1.0 - (singular[-1] / config.damping_below) ** 2)
        damping = config.damping**2 * nearness
        velocity = right[:6].T @ (singular / (singular**2 + damping) * (left.T @ twist))
        velocity += right[6] * self._elbow_speed(right[6], q, twist)
        velocity = self._away_from_capsules(q, velocity)
        self._singularity_scale = self._scale_at_singularity(
            q, velocity, left[:, -1], right[5], singular[-1]
        )
        if self._singularity_scale < SLOWED:
            self._limits |= Limit.SINGULARITY
        return velocity * self._singularity_scale * self._scale_at_joints(q, velocity)

    def _elbow_speed(self, null_vector: np.ndarray, q: np.ndarray, twist: np.ndarray) -> float:
        """rad/s along the null space towards the home posture; the elbow rests with the hand."""
        config = self.config
        wish = config.posture_gain * float(null_vector @ (self.arm.home - q))
        hand_speed = np.linalg.norm(twist[:3]) / 0.02 + np.linalg.norm(twist[3:]) / 0.1
        moving = min(1.0, float(hand_speed))
        return moving * min(max(wish, -config.posture_speed), config.posture_speed)

    def _scale_at_singularity(
        self,
        q: np.ndarray,
        velocity: np.ndarray,
        left: np.ndarray,
        right: np.ndarray,
        smallest: float,
    ) -> float:
        """Scale that lets the smallest singular value fall no faster than its distance allows.

        Its rate is left' dJ/dt right. Moving away from a singularity is never slowed.
        """
        ahead = self.arm.jacobian_tcp(q + LOOK_AHEAD * velocity)
        rate = (float(left @ ahead @ right) - smallest) / LOOK_AHEAD
        allowed = self.config.limit_gain * max(smallest - self.config.singularity_stop, 0.0)
        return 1.0 if -rate <= allowed else allowed / -rate

    def _scale_at_joints(self, q: np.ndarray, velocity: np.ndarray) -> float:
        """Scale that keeps the velocity limit and slows in front of the position limits."""
        margin = self.config.joint_margin
        room = np.where(velocity > 0, self.arm.upper - margin - q, q - self.arm.lower - margin)
        allowed = np.minimum(
            self.config.limit_gain * np.maximum(room, 0.0),
            SPEED_RESERVE * self.config.joint_velocity,
        )
        scale = float(min(1.0, (allowed / np.maximum(np.abs(velocity), 1e-12)).min()))
        if scale < SLOWED:
            self._limits |= Limit.JOINT
        return scale

    def _away_from_capsules(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """(7,) rad/s with which no two links, and no link and the table, approach too fast.

        Speed may not exceed limit_gain times what is left of their distance. What is too much of
        it is taken out; the arm slides along, and moving apart is never slowed.
        """
        motion = self._motion
        room = motion.room()
        allowed = self.config.limit_gain * np.maximum(room - self.config.approach_margin, 0.0)
        near = np.flatnonzero(allowed < motion.clearance.fastest(velocity))
        if not len(near):
            return velocity
        slopes, allowed = motion.clearance.gradient(q, near), allowed[near]
        for _ in range(PROJECTIONS):
            excess = -slopes @ velocity - allowed
            worst = int(excess.argmax())
            if excess[worst] <= 1e-9:
                return velocity
            is_self = near[worst] < motion.clearance.self_pairs
            self._limits |= Limit.SELF_COLLISION if is_self else Limit.TABLE
            slope = slopes[worst]
            velocity = velocity + excess[worst] / max(float(slope @ slope), 1e-6) * slope
        # Caught between several of them.
        approach = np.maximum(-slopes @ velocity, 1e-12)
        return velocity * min(1.0, float((allowed / approach).min()))

    def _hold(self, state: ServoState, message: str) -> None:
        """Changes state to one that stands: the arm brakes, later motion starts where it stops."""
        self.state, self.message = state, message
        self._singularity_scale = 1.0
        self._gripper_asked = self._gripper
        self._reference.anchor(self.arm.tcp_placement(self._motion.stop_position))

    def _end_goal(self, outcome: GoalState) -> None:
        if self._goal_state is GoalState.RUNNING:
            self._goal_state = outcome
        self._goal_path = []

    def _observe(self, measured_q: Sequence[float] | np.ndarray | None, now: float) -> None:
        """Takes in a measured posture; a bad, late or far one ends in a fault."""
        enabled = self.state in (ServoState.READY, ServoState.MOVING, ServoState.HALTED)
        if measured_q is not None:
            try:
                self._measured = finite_vector("measured posture", measured_q, DOF)
                self._measured_time = now
            except ValueError as error:
                self.fault(str(error))
                return
        if self._measured is None:
            return
        self._tracking_error = float(np.abs(self._motion.state.position - self._measured).max())
        if enabled and not 0.0 <= now - self._measured_time <= self.config.measurement_timeout:
            self.fault(f"no measured posture for {now - self._measured_time:.2f} s")
        elif enabled and self._tracking_error > self.config.tracking_limit:
            self.fault(
                f"tracking error {self._tracking_error:.3f} rad, limit {self.config.tracking_limit}"
            )

    def _checked_posture(self, name: str, q: Sequence[float] | np.ndarray) -> np.ndarray:
        """(7,) posture inside the joint limits and the box, near to nothing, or MoveRejected."""
        try:
            posture = finite_vector(name, q, DOF)
        except ValueError as error:
            raise MoveRejected(str(error)) from error
        for joint, value, low, high in zip(
            self.arm.names, posture, self.arm.lower, self.arm.upper, strict=True
        ):
            if not low <= value <= high:
                raise MoveRejected(f"{name}: {joint} {value:.4f} rad, limits {low:.4f}..{high:.4f}")
        tcp = self.arm.tcp_placement(posture).translation
        box = zip("xyz", tcp, self.config.box_lower, self.config.box_upper, strict=True)
        for axis, value, low, high in box:
            if not low <= value <= high:
                raise MoveRejected(f"{name}: TCP {axis} {value:.4f} m, workspace box {low}..{high}")
        if near := self._motion.too_near(posture):
            raise MoveRejected(f"{name}: {near}")
        return posture

    def _checked_action(
        self, translation: Sequence[float] | np.ndarray, rotation: Sequence[float] | np.ndarray
    ) -> np.ndarray:
        """(6,) delta, or ValueError naming what is wrong with it."""
        if self._goal_state is GoalState.RUNNING:
            raise ValueError("action: a move_to goal is running")
        if self.state in (ServoState.DISABLED, ServoState.FAULT):
            raise ValueError(f"action: state is {self.state.name}, not enabled")
        moved = finite_vector("translation", translation, 3)
        turned = finite_vector("rotation", rotation, 3)
        limits = (
            ("translation", moved, self.config.action_translation, "m"),
            ("rotation", turned, self.config.action_rotation, "rad"),
        )
        for name, vector, limit, unit in limits:
            size = math.hypot(*vector)
            if size > limit * (1 + 1e-9):
                raise ValueError(f"{name}: {size:.6g} {unit}, limit of one action {limit:g} {unit}")
        return np.concatenate([moved, turned])

    def _count(self, **increments: int) -> None:
        new = {name: getattr(self.counters, name) + n for name, n in increments.items()}
        self.counters = replace(self.counters, **new)

    def _output(self, braking: bool) -> ServoOutput:
        active = braking or self.state not in (ServoState.DISABLED, ServoState.FAULT)
        state = self._motion.state
        if not active and self._measured is not None:
            state = JointState.standing(self._measured)
        remaining = 0.0
        if self._goal_path:
            remaining = float(np.abs(self._goal_path[-1].position - state.position).max())
        return ServoOutput(
            position=state.position.copy(),
            velocity=state.velocity.copy(),
            acceleration=state.acceleration.copy(),
            active=active,
            state=self.state,
            message=self.message,
            gripper=self._gripper,
            limits=self._limits,
            singularity_scale=self._singularity_scale,
            tracking_error=self._tracking_error,
            goal=self._goal_state,
            goal_remaining=remaining,
            counters=self.counters,
        )
