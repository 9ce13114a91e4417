"""Every limit and setting of the Cartesian servo, with its unit and where it comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True)
class ServoConfig:
    """Defaults: for fragile objects on a table, well inside what the arm itself allows.

    Raises ValueError, naming the field, for a value that is not finite or makes no sense.
    """

    # Timing. 0.15 s and the 0.3 s stop are the project's fault criteria.
    period: float = 0.01  # s, one `step`; 100 Hz is inside UFACTORY's advice of 50-200 Hz
    action_period: float = 0.05  # s, over which one action is spread
    action_timeout: float = 0.15  # s, an older action is stale: halt
    measurement_timeout: float = 0.2  # s without a measured posture: fault
    gripper_delay: float = 0.05  # s that a gripper target is on its way; DriverConfig.delay

    # One action.
    action_translation: float = 0.0125  # m, norm; linear_speed * action_period
    action_rotation: float = 0.05  # rad, norm; angular_speed * action_period

    # Cartesian motion of link_tcp. The speeds are far below the controller's 1 m/s (SDK x3/base.py)
    # and the 0.25 m/s that ISO 10218-1 names for reduced speed.
    linear_speed: float = 0.25  # m/s
    angular_speed: float = 1.0  # rad/s
    box_lower: tuple[float, float, float] = (0.20, -0.40, 0.0)  # m, link_tcp in link_base
    box_upper: tuple[float, float, float] = (0.75, 0.40, 0.60)  # m
    box_margin: float = 0.002  # m, how far inside the box targets stay
    smoothing: float = 0.02  # s, of each of the three lags; at least 2 periods
    gain: float = 10.0  # 1/s, of the error between reference and commanded pose
    tcp_speed_limit: float = 0.5  # m/s, of any set-point: a motion that exceeds it is not begun
    leash: float = 0.06  # m, largest lead of the reference over the commanded pose
    leash_rotation: float = 0.25  # rad

    # Joints. The arm allows 3.14 rad/s (URDF) and 20 rad/s^2 (SDK x3/base.py). Servo mode has no
    # jerk limit of its own; this one and the other two make the slowest stop last 0.14 s.
    joint_velocity: float = 1.2  # rad/s
    joint_acceleration: float = 15.0  # rad/s^2
    joint_jerk: float = 500.0  # rad/s^3
    joint_margin: float = 0.02  # rad, how far from its limits a joint stays
    tracking_limit: float = 0.2  # rad, larger |commanded - measured|: fault

    # Approach to the box, joint limits and singularities: speed <= limit_gain * distance to it.
    limit_gain: float = 10.0  # 1/s
    singularity_stop: float = 0.03  # smallest singular value of the Jacobian, never undercut
    damping_below: float = 0.06  # smallest singular value below which least squares are damped
    damping: float = 0.03  # largest damping factor

    # Clearance of capsules around the links (capsules.py) and of the hand, never undercut by a
    # set-point; the servo stops `approach_margin` earlier. The fingers may touch the table.
    self_collision_margin: float = 0.01  # m, between any two links that could meet
    table_height: float = 0.0  # m, z of the table in link_base
    table_margin: float = 0.01  # m, of links and the gripper's body above the table
    approach_margin: float = 0.002  # m
    finger_margin: float = 0.0001  # m, how far above the table the fingers are stopped

    # Elbow: pulled towards the home posture, only while the hand moves.
    posture_gain: float = 1.0  # 1/s
    posture_speed: float = 0.2  # rad/s

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if isinstance(value, (tuple, list)) else (value,)
            if not all(math.isfinite(number) for number in numbers):
                raise ValueError(f"{field.name}: not finite: {value}")
            if not field.name.startswith(("box_", "table_height")) and value <= 0:
                raise ValueError(f"{field.name}: {value}, expected more than 0")
        if len(self.box_lower) != 3 or len(self.box_upper) != 3:
            raise ValueError("box_lower, box_upper: expected 3 numbers each")
        if self.box_margin < 0:
            raise ValueError(f"box_margin: {self.box_margin}, expected 0 or more")
        room = 2 * self.box_margin
        if any(hi - lo <= room for lo, hi in zip(self.box_lower, self.box_upper, strict=True)):
            raise ValueError("box_upper: not above box_lower by more than two margins")
        if self.period > self.action_period:
            raise ValueError("period: longer than action_period")
        if self.tcp_speed_limit < self.linear_speed:
            raise ValueError("tcp_speed_limit: less than linear_speed")
        if self.smoothing < 2 * self.period:
            raise ValueError(f"smoothing: {self.smoothing} s, expected at least two periods")
