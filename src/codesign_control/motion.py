"""Joint motion that can always stop: the last gate before a set-point leaves the library.

Every step is proposed first and taken only when the arm could still brake from it, jerk-limited,
without leaving the joint limits, the velocity limits or the workspace box and without coming too
near to itself or the table. Otherwise the arm moves
on along the stop that was found safe one tick earlier. So, by induction, nothing that is asked of
this class can make it break a limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from ruckig import ControlInterface, InputParameter, Result, Ruckig, Synchronization, Trajectory

from codesign_control.clearance import Clearance, HandHeight
from codesign_control.config import ServoConfig
from codesign_control.hand import Hand
from codesign_control.xarm7 import Xarm7

DOF = 7
AT_REST = 1e-9  # rad/s, rad/s^2: below it a joint counts as standing
PLAN_ATTEMPTS = 10
PLAN_RESERVE = 0.9  # of the TCP speed limit: braking may add a little to a plan's speed
ROUNDING = 1e-9  # relative slack for limits that are met exactly


class Limit(IntFlag):
    """What slows or stops a motion. Numbered as in ControllerStatus.msg."""

    NONE = 0
    JOINT = 1  # position or velocity of a joint
    BOX = 2
    SELF_COLLISION = 4
    TABLE = 8
    SINGULARITY = 16
    TCP_SPEED = 32


@dataclass(frozen=True)
class JointState:
    """position (7,) rad, velocity (7,) rad/s, acceleration (7,) rad/s^2."""

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray

    @staticmethod
    def standing(position: np.ndarray) -> JointState:
        return JointState(np.array(position, dtype=float), np.zeros(DOF), np.zeros(DOF))

    def profile(self) -> np.ndarray:
        """(1, 3, 7): this state as a profile (see JointMotion) of one tick."""
        return np.array([[self.position, self.velocity, self.acceleration]])

    @property
    def at_rest(self) -> bool:
        return bool(
            np.abs(self.velocity).max() < AT_REST and np.abs(self.acceleration).max() < AT_REST
        )


class TrajectoryError(RuntimeError):
    """Ruckig found no trajectory; the message holds its result and what was asked."""


class JointMotion:
    """The commanded joint state and the stop that is known to be safe from it.

    A profile is a (n, 3, 7) array: position, velocity and acceleration at n coming ticks, standing
    at the last one.
    """

    def __init__(
        self, arm: Xarm7, config: ServoConfig, position: np.ndarray, hand: Hand | None = None
    ) -> None:
        self._arm = arm
        self._config = config
        self.set_hand(hand or Hand())
        self._box_lower = np.asarray(config.box_lower)
        self._box_upper = np.asarray(config.box_upper)
        self._generator = Ruckig(DOF, config.period)
        self.stand(position)

    def stand(self, position: np.ndarray) -> None:
        """Starts again at rest at `position`."""
        self.state = JointState.standing(position)
        self._stop = self.state.profile()

    def set_hand(self, hand: Hand) -> None:
        """From here on the arm carries another hand; for an arm that stands."""
        self.clearance = Clearance(self._config, hand)
        self.hand_height = HandHeight(self._config, hand)
        self._room_at: tuple[np.ndarray, np.ndarray] | None = None
        self.refused = Limit.NONE  # why the last `follow` was refused

    def room(self) -> np.ndarray:
        """`Clearance.room` where the arm is now; computed once per posture."""
        if self._room_at is None or self._room_at[0] is not self.state.position:
            self._room_at = self.state.position, self.clearance.room(self.state.position)
        return self._room_at[1]

    def allows_widths(self, widths: tuple[float, float]) -> bool:
        """Whether the fingers, between two gaps [m], stay off the table until the arm stands."""
        path = self._tcp_path(self._stop)
        return bool(self.hand_height.least(path, widths).min() >= 0.0)

    @property
    def stop_position(self) -> np.ndarray:
        """(7,) where the arm would stand if it braked from now on."""
        return self._stop[-1, 0]

    def brake(self) -> None:
        """One tick along the safe stop."""
        self.state = JointState(*self._stop[0])
        self._stop = self._stop[1:] if len(self._stop) > 1 else self._stop

    def follow_velocity(self, velocity: np.ndarray) -> bool:
        """One tick towards a joint velocity; False when that was unsafe and the arm braked."""
        return self.follow(self._towards(velocity))

    def follow(self, state: JointState) -> bool:
        """One tick to `state`; False when no safe stop starts there and the arm braked instead."""
        stop = self._safe_stop(state)
        if stop is None:
            self.brake()
            return False
        self.state, self._stop = state, stop
        return True

    def plan(self, goal: np.ndarray, speed_scale: float) -> list[JointState]:
        """States at the coming ticks of a jerk-limited motion to `goal`, where it stands.

        speed_scale is lowered where the TCP would exceed its speed limit. Raises TrajectoryError
        when Ruckig fails, ValueError when the motion leaves the joint limits or the box.
        """
        request = self._request(self.state)
        request.target_position = goal.tolist()
        request.synchronization = Synchronization.Time
        for _ in range(PLAN_ATTEMPTS):
            request.max_velocity = [self._config.joint_velocity * speed_scale] * DOF
            motion = self._sample(request)
            path = self._tcp_path(motion)
            speed = self._peak_speed(path)
            allowed = PLAN_RESERVE * self._config.tcp_speed_limit
            if speed <= allowed:
                break
            speed_scale *= 0.95 * allowed / speed
        if violated := self._violated(motion, path):
            raise ValueError(f"the way leaves a limit: {describe(violated)}")
        return [JointState(*state) for state in motion]

    def _towards(self, velocity: np.ndarray) -> JointState:
        """The state after one tick of constant jerk towards a joint velocity.

        Away from the limits: two lags of `smoothing`, critically damped. A time-optimal retarget
        (Ruckig) in every tick would instead swing between the two jerk limits.
        """
        config, dt = self._config, self._config.period
        q, v, a = self.state.position, self.state.velocity, self.state.acceleration
        # All joints are slowed by one factor, which keeps the direction of the motion.
        change = velocity - v
        wanted = change / (2.0 * config.smoothing)  # acceleration
        braking = np.sqrt(1.6 * config.joint_jerk * np.abs(change))  # can still return to zero
        wanted *= _scale_into(wanted, np.minimum(braking, config.joint_acceleration))
        jerk = (wanted - a) * 2.0 / config.smoothing
        jerk *= _scale_into(jerk, config.joint_jerk)
        return JointState(
            q + dt * (v + dt * (a / 2 + dt * jerk / 6)), v + dt * (a + dt * jerk / 2), a + dt * jerk
        )

    def _safe_stop(self, state: JointState) -> np.ndarray | None:
        """Profile of the stop from `state`, or None where it would leave a limit."""
        most = self._config.joint_acceleration * (1 + ROUNDING)
        if not np.abs(state.acceleration).max() <= most:  # NaN is unsafe, too
            self.refused = Limit.JOINT
            return None
        if state.at_rest:
            stop = JointState.standing(state.position).profile()
        else:
            request = self._request(state)
            request.control_interface = ControlInterface.Velocity
            # Joints that stop together keep the TCP nearer to its path than each as soon as it can.
            request.synchronization = Synchronization.Phase
            stop = self._sample(request)
        ahead = np.concatenate([state.profile(), stop])
        self.refused = self._violated(ahead, self._tcp_path(ahead))
        return None if self.refused else stop

    def too_near(self, position: np.ndarray) -> str:
        """What an arm standing at (7,) rad would come too near to; "" for nothing."""
        room = self.clearance.room(position)
        if room.min() < 0.0:
            return self.clearance.describe(room)
        low = self.hand_height.least(self._arm.tcp_placement(position).homogeneous[None])[0]
        return f"hand {-1e3 * low:.1f} mm too low over the table" if low < 0.0 else ""

    def _violated(self, profile: np.ndarray, path: np.ndarray) -> Limit:
        """The limits that a profile and its TCP path leave; not acceleration and jerk."""
        violated = Limit.NONE
        speed = np.abs(profile[:, 1]).max()
        if not (
            self._arm.within_limits(profile[:, 0])
            and speed <= self._config.joint_velocity * (1 + ROUNDING)
        ):
            violated |= Limit.JOINT
        tcp = path[:, :3, 3]
        if not ((tcp >= self._box_lower).all() and (tcp <= self._box_upper).all()):
            violated |= Limit.BOX
        if not self._peak_speed(path) <= self._config.tcp_speed_limit * (1 + ROUNDING):
            violated |= Limit.TCP_SPEED
        heights = self.hand_height.least(path)
        # A hand that something else pushed too low may still be raised.
        if not heights.min() >= min(0.0, heights[0]) - 1e-12:
            violated |= Limit.TABLE
        return violated | self._too_near(profile[:, 0])

    def _too_near(self, postures: np.ndarray) -> Limit:
        """SELF_COLLISION or TABLE where a capsule of the arm loses its margin in (n, 7) rad."""
        moved = self.clearance.fastest(postures - self.state.position)
        for q in postures[(moved >= self.room()).any(axis=1)]:
            if not self.clearance.clear(q):
                rooms = self.clearance.room(q)[: self.clearance.self_pairs]
                return Limit.SELF_COLLISION if rooms.min() < 0.0 else Limit.TABLE
        return Limit.NONE

    def _tcp_path(self, profile: np.ndarray) -> np.ndarray:
        """(n + 1, 4, 4): placements of `link_tcp`, from where it is now along a profile."""
        postures = (self.state.position, *profile[:, 0])
        return np.array([self._arm.tcp_placement(q).homogeneous for q in postures])

    def _peak_speed(self, path: np.ndarray) -> float:
        """Largest speed [m/s] along a path of one point per tick; 0 of a single point."""
        steps = np.diff(path[:, :3, 3], axis=0)
        return float(np.sqrt((steps * steps).sum(axis=1).max(initial=0.0))) / self._config.period

    def _request(self, state: JointState) -> InputParameter:
        """A Ruckig request from `state` to rest, at full limits."""
        request = InputParameter(DOF)
        request.current_position = state.position.tolist()
        request.current_velocity = state.velocity.tolist()
        request.current_acceleration = state.acceleration.tolist()
        request.max_velocity = [self._config.joint_velocity] * DOF
        request.max_acceleration = [self._config.joint_acceleration] * DOF
        request.max_jerk = [self._config.joint_jerk] * DOF
        return request

    def _sample(self, request: InputParameter) -> np.ndarray:
        """Profile of Ruckig's answer, up to and including the first tick at which it stands."""
        trajectory = Trajectory(DOF)
        result = self._generator.calculate(request, trajectory)
        if result not in (Result.Working, Result.Finished):
            raise TrajectoryError(f"Ruckig: {result.name} for {request}")
        dt = self._config.period
        ticks = max(1, int(np.ceil(trajectory.duration / dt)))
        times = [i * dt for i in range(1, ticks)] + [trajectory.duration]
        profile = np.array([trajectory.at_time(time)[:3] for time in times])
        profile[-1, 1:] = 0.0  # exactly, where Ruckig's answer is rounded
        return profile


def describe(limits: Limit) -> str:
    """The limits' names, as in "box, table"."""
    return ", ".join(str(limit.name).lower().replace("_", " ") for limit in limits)


def _scale_into(values: np.ndarray, limit: np.ndarray | float) -> float:
    """The largest factor up to 1 that brings every |value| under its limit."""
    excess = np.abs(values) / np.maximum(limit, 1e-300)  # 0 under a limit of 0 is no excess
    return 1.0 / max(1.0, float(excess.max()))
