"""Every setting of the arm's driver, with its unit and where it comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

GRIPPERS = ("g1", "g2", "none")

# rad. SDK x_config.py for serials from XI1305 on, which lie inside those of earlier arms; joint 6
# as xarm_ros2. The same numbers as in xarm7.urdf, which this module need not load.
JOINT_LOWER = (-6.283185, -2.042035, -6.283185, -0.10472, -6.283185, -1.692969, -6.283185)
JOINT_UPPER = (6.283185, 2.024581, 6.283185, 3.92699, 6.283185, 3.141592, 6.283185)


@dataclass(frozen=True)
class DriverConfig:
    """How the driver streams and what it refuses.

    Raises ValueError, naming the field, for a value that is not finite or makes no sense.
    """

    address: str = "192.168.1.200"  # IPv4 address of the control box
    rate: int = 100  # Hz, servo points; UFACTORY's servo guide: at most 250, advised 50-200
    realtime: bool = False  # SCHED_FIFO for the streaming thread, where permitted
    dry_run: bool = False  # connect, read and report; never enable, never command
    gripper: str = "g2"  # "g1", "g2" or "none"

    # What is refused. Limits of the joints: [rad].
    joint_lower: tuple[float, ...] = JOINT_LOWER
    joint_upper: tuple[float, ...] = JOINT_UPPER
    # rad/s, of commands and of what goes out. The controller asks for at most 1.2 (ServoConfig) and
    # catching up goes 1.2 times as fast; the arm allows 3.14 (URDF).
    joint_velocity: float = 1.5
    command_timeout: float = 0.15  # s, age of a command that counts no more; then streaming pauses
    early_limit: float = 0.2  # s, a command meant for later than this has a wrong clock

    # How streaming begins.
    match_tolerance: float = 0.01  # rad, first command to measured posture, every joint
    match_speed: float = 0.05  # rad/s, of the command and of the arm
    blend_time: float = 0.5  # s, over which what is left of that difference goes away

    # How set-points are played.
    delay: float = 0.05  # s after its moment a set-point goes out: jitter up to that stays out

    # The control box.
    reply_share: float = 0.6  # of a period that a call waits for its reply: a tick is never missed
    reply_patience: float = 0.05  # s without reply and report while streaming: the box hangs
    answer_timeout: float = 0.5  # s of late replies only, while reports come: a fault as well
    report_timeout: float = 0.25  # s without a report: the connection counts as lost
    reconnect_period: float = 0.25  # s between two attempts
    call_timeout: float = 1.0  # s, of calls outside streaming

    # The gripper.
    gripper_rate: float = 20.0  # Hz, its readings and at most its commands
    gripper_speed: float = 0.1  # m/s of the gap, when a command names none
    gripper_effort: float = 0.3  # share of the largest force of G2, when a command names none

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(n, float) and not math.isfinite(n) for n in numbers):
                raise ValueError(f"{field.name}: not finite: {value}")
            if isinstance(value, (int, float)) and not isinstance(value, bool) and value <= 0:
                raise ValueError(f"{field.name}: {value}, expected more than 0")
        if not 20 <= self.rate <= 250:
            raise ValueError(f"rate: {self.rate} Hz, expected 20..250 (the arm takes at most 250)")
        if self.gripper not in GRIPPERS:
            raise ValueError(f"gripper: {self.gripper!r}, expected one of {', '.join(GRIPPERS)}")
        if len(self.joint_lower) != 7 or len(self.joint_upper) != 7:
            raise ValueError("joint_lower, joint_upper: expected 7 angles each")
        if any(lo >= hi for lo, hi in zip(self.joint_lower, self.joint_upper, strict=True)):
            raise ValueError("joint_upper: not above joint_lower")
        if not self.reply_share < 0.8:
            raise ValueError(f"reply_share: {self.reply_share}, expected less than 0.8")
        if not self.gripper_effort <= 1.0:
            raise ValueError(f"gripper_effort: {self.gripper_effort}, expected at most 1")

    @property
    def period(self) -> float:
        """Time between two servo points [s]."""
        return 1.0 / self.rate

    @property
    def largest_step(self) -> float:
        """Of any joint from one servo point to the next [rad]."""
        return self.joint_velocity * self.period
