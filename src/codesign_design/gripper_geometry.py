"""The xArm gripper's four-bar and the parts of it that a finger must not touch.

Frame of lengths here: the gripper's base, the flange `link_eef` (m; y along the closing direction,
z towards the TCP), and the finger link, which moves in it without turning. Dimensions: xarm_ros2,
`xarm_gripper.urdf.xacro`, and the manufacturer's mesh of the base.
"""

import math

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import MOUNT_FACE
from codesign_design.stock import DEPTH, STROKE

PIVOT = np.array([0.035, 0.059098])  # m, (y, z) of the drive joint
CRANK = np.array([0.035465, 0.042039])  # m, from the drive joint to the finger link at q = 0
DRIVE_LIMIT = 0.85  # rad, closed; 0 is open
STOCK_PROTRUSION = MOUNT_FACE + DEPTH  # m, stock pad face from the finger link's origin

# The inner knuckle runs parallel to the crank, from this place in the finger link to the base.
KNUCKLE_IN_LINK = np.array([-0.015, 0.015])  # m, (y, z)
KNUCKLE_RADIUS = 0.005  # m; the stock finger's nearest corner leaves exactly this much room
KNUCKLE_HALF_WIDTH = 0.016  # m, assumed as wide as the stock finger's frame
PALM_Z = 0.099  # m, highest face of the base, the plate between the fingers


def crank(drive_joint: float) -> NDArray[np.float64]:
    """From the drive joint's pivot to the finger link's origin, (y, z) [m]."""
    cos, sin = math.cos(drive_joint), math.sin(drive_joint)
    return np.array([CRANK[0] * cos - CRANK[1] * sin, CRANK[0] * sin + CRANK[1] * cos])


def link_origin(drive_joint: float) -> NDArray[np.float64]:
    """The left finger link's origin in the gripper's base, (y, z) [m]."""
    return PIVOT + crank(drive_joint)


def gap(drive_joint: float, protrusion: float) -> float:
    """Between the most protruding points [m]; negative where the fingers would overlap.

    `protrusion` is theirs from the finger link's origin, see `FingerPair.protrusion`.
    """
    return 2.0 * float(link_origin(drive_joint)[0] - protrusion)


def drive_joint_at(width: float, protrusion: float) -> float | None:
    """Drive joint [rad] at a gap [m]; None where it is outside its range."""
    reach = width / 2.0 + protrusion - PIVOT[0]
    length = float(np.hypot(*CRANK))
    if abs(reach) > length:
        return None
    joint = math.acos(reach / length) - math.atan2(CRANK[1], CRANK[0])
    return min(max(joint, 0.0), DRIVE_LIMIT) if -1e-9 <= joint <= DRIVE_LIMIT + 1e-9 else None


def usable_gap(protrusion: float) -> tuple[float, float]:
    """Smallest and largest gap [m] that the drive reaches with fingers of this protrusion.

    The manual's stroke bounds the opening; it is a little less than the four-bar's. A shallow
    finger cannot touch its partner, a deep one touches it before the drive's end.
    """
    widest = STROKE - 2.0 * (protrusion - STOCK_PROTRUSION)
    return max(0.0, gap(DRIVE_LIMIT, protrusion)), widest


def knuckle_sweep(samples: int = 18) -> NDArray[np.float64]:
    """What the inner knuckle's axis covers in the finger link over the whole drive, (K, 2, 2) [m].

    Each entry is a segment of (y, z) points, from the finger link's end to the base's.
    """
    joints = np.linspace(0.0, DRIVE_LIMIT, samples)
    return np.array([[KNUCKLE_IN_LINK, KNUCKLE_IN_LINK - crank(q)] for q in joints])
