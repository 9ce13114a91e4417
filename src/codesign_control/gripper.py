"""The xArm parallel gripper: its four-bar and its motion.

Two mirrored four-bars carry the fingers, so a finger moves along the tool's z axis while it moves
sideways, without turning. Frame: the gripper's base, which is the flange `link_eef` (m; y is the
closing direction, z points from the arm to the TCP). Dimensions: xarm_ros2
`xarm_gripper.urdf.xacro` (drive_joint and left_finger_joint origins).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

PIVOT_Y, PIVOT_Z = 0.035, 0.059098  # m, drive joint
CRANK_Y, CRANK_Z = 0.035465, 0.042039  # m, from the drive joint to the finger at q = 0
CRANK = math.hypot(CRANK_Y, CRANK_Z)
CRANK_ANGLE = math.atan2(CRANK_Z, CRANK_Y)
DRIVE_LIMIT = 0.85  # rad, closed; 0 is open
STOCK_PROTRUSION = 0.026  # m, the stock pad's face, from the finger link's origin


@dataclass(frozen=True)
class GripperSpec:
    """What a gripper's controller accepts."""

    name: str
    stroke: float  # m, 0..stroke between the stock pads
    min_speed: float  # m/s, of the gap
    max_speed: float  # m/s, of the gap


# Speeds of G1 are set in motor turns; its drive joint's 2 rad/s (URDF) is at least 0.168 m/s of the
# gap, anywhere in its stroke. Stroke: UFACTORY manual.
G1 = GripperSpec("G1", stroke=0.084, min_speed=0.0, max_speed=0.168)
# Stroke and speed: xArm Python SDK.
G2 = GripperSpec("G2", stroke=0.084, min_speed=0.015, max_speed=0.225)


@dataclass(frozen=True)
class GripperMotion:
    """Where the gripper is: width m, velocity m/s of the width, drive_joint rad, finger_z m."""

    width: float
    velocity: float
    drive_joint: float
    finger_z: float
    moving: bool


class GripperModel:
    """Width, drive joint and rate-limited motion of a gripper with a given pair of fingers.

    width: gap between the two fingers' most protruding points [m].
    protrusion: distance of that point from the finger link's origin, along the closing direction
    [m]. Deeper fingers meet before the drive joint's end, so `min_width` is never below 0.
    limits: smallest and largest gap that the fingers themselves allow [m].
    Raises ValueError for a protrusion or limits with which the fingers cannot open, and everywhere
    for values that are not finite.
    """

    def __init__(
        self,
        protrusion: float = STOCK_PROTRUSION,
        spec: GripperSpec = G2,
        width: float | None = None,
        limits: tuple[float, float] = (0.0, math.inf),
    ) -> None:
        self.protrusion = _finite("protrusion", protrusion)
        self.spec = spec
        self.max_width = min(limits[1], self.width_of(0.0))
        self.min_width = max(0.0, limits[0], self.width_of(DRIVE_LIMIT))
        if not self.max_width > self.min_width:
            raise ValueError(
                f"protrusion: {protrusion} m and limits {limits[0]}..{limits[1]} m leave the "
                "fingers no room to open"
            )
        self.width = self.max_width if width is None else self.clip(width)

    @staticmethod
    def finger_position(drive_joint: float) -> tuple[float, float]:
        """(y, z) of the finger link's origin in the gripper's base [m]."""
        angle = drive_joint + CRANK_ANGLE
        return PIVOT_Y + CRANK * math.cos(angle), PIVOT_Z + CRANK * math.sin(angle)

    def width_of(self, drive_joint: float) -> float:
        """Gap [m] at a drive joint position [rad]; negative where the fingers would overlap."""
        return 2.0 * (self.finger_position(drive_joint)[0] - self.protrusion)

    def drive_joint(self, width: float) -> float:
        """Drive joint position [rad] at a gap [m]; ValueError outside min_width..max_width."""
        _finite("width", width)
        if not self.min_width - 1e-12 <= width <= self.max_width + 1e-12:
            raise ValueError(f"width: {width} m, range {self.min_width:.5f}..{self.max_width:.5f}")
        y = width / 2.0 + self.protrusion
        angle = math.acos(min(max((y - PIVOT_Y) / CRANK, -1.0), 1.0)) - CRANK_ANGLE
        return min(max(angle, 0.0), DRIVE_LIMIT)

    def finger_z(self, width: float) -> float:
        """Shift of the fingers along tool z at a gap [m]: 0 with the drive joint at its closed end.

        That end is the reference because the TCP (0.172 m) lies at the stock fingertips there.
        Fully open the fingers are 12.35 mm nearer to the arm (negative).
        """
        closed = self.finger_position(DRIVE_LIMIT)[1]
        return self.finger_position(self.drive_joint(width))[1] - closed

    def clip(self, width: float) -> float:
        """The nearest gap [m] that these fingers reach."""
        return min(max(_finite("width", width), self.min_width), self.max_width)

    def step(self, target_width: float, dt: float, speed: float = 0.0) -> GripperMotion:
        """Moves towards a gap [m] for dt s and returns where the gripper is.

        speed: m/s of the gap, limited to what the gripper accepts; 0: its largest.
        """
        if not dt > 0:
            raise ValueError(f"dt: {dt} s, expected more than 0")
        if _finite("speed", speed) < 0:
            raise ValueError(f"speed: {speed} m/s, expected 0 or more")
        target = self.clip(target_width)
        rate = min(max(speed or self.spec.max_speed, self.spec.min_speed), self.spec.max_speed)
        before = self.width
        move = min(max(target - before, -rate * dt), rate * dt)
        self.width = target if abs(target - before) <= rate * dt else before + move
        return GripperMotion(
            width=self.width,
            velocity=(self.width - before) / dt,
            drive_joint=self.drive_joint(self.width),
            finger_z=self.finger_z(self.width),
            moving=self.width != target,
        )


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{name}: not finite: {value}")
    return float(value)
