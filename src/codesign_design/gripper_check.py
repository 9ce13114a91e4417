"""How a finger pair works in the xArm gripper: contact, opening, room for the gripper's parts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import MOUNT_FACE, TriangleMesh
from codesign_design.gripper_geometry import (
    KNUCKLE_HALF_WIDTH,
    KNUCKLE_RADIUS,
    PALM_Z,
    drive_joint_at,
    knuckle_sweep,
    link_origin,
    usable_gap,
)
from codesign_design.stock import LINK_Z

BLOCK = 0.030  # m, the side of the tofu block that the fingers close on
PLAY = 0.008  # m, for the block between the open fingers, both sides together
CONTACT_LAYER = 0.0005  # m: what touches a flat wall pressed in this far
CLEARANCE = -2e-5  # m, least; facets of a circle and rounding count as touching


@dataclass(frozen=True)
class GripperCheck:
    """Kinematics of a finger and its mirror image.

    They meet in the plane between them, at their most protruding points and nowhere before, and
    move up and down together: other collisions of one with the other are impossible.

    Attributes:
        min_width, max_width: usable gap between the most protruding points [m].
        needed_width: gap to go down over the block [m]: block and play. Between the pads behind
            two lips it is wider by both lips' length.
        contact_drive_joint: drive joint where the fingers first touch [rad]; None: they cannot.
        block_drive_joint: where they first touch the block's sides [rad]; None: they cannot.
        contact_angle: between the contact face's mean normal and the closing direction [rad].
        contact_area: of what lies within `CONTACT_LAYER` of the most protruding point, seen
            along the closing direction [m^2].
        palm_clearance: open fingers to the gripper's base [m]; negative where they collide.
        knuckle_clearance: finger to its inner knuckle, anywhere in the drive [m].
    """

    min_width: float
    max_width: float
    needed_width: float
    contact_drive_joint: float | None
    block_drive_joint: float | None
    contact_angle: float
    contact_area: float
    palm_clearance: float
    knuckle_clearance: float

    @property
    def problems(self) -> list[str]:
        """What makes the pair unusable, each with its value and limit."""
        found = []
        if self.max_width < self.needed_width:
            found.append(
                f"opens by {self.max_width * 1e3:.1f} mm only, a {BLOCK * 1e3:g} mm block needs "
                f"{self.needed_width * 1e3:g} mm: make the finger less deep"
            )
        for part, room in (("base", self.palm_clearance), ("knuckle", self.knuckle_clearance)):
            if room < CLEARANCE:
                found.append(
                    f"collides with the gripper's {part} by {-room * 1e3:.2f} mm: shorten the "
                    "finger at its upper end"
                )
        return found


def check_gripper(left: TriangleMesh) -> GripperCheck:
    """Checks the left finger, in the grasp frame at gap 0, and its mirror image.

    Its largest y is the mount face.
    """
    depth = float(left.vertices[:, 1].max())
    protrusion = MOUNT_FACE + depth
    min_width, max_width = usable_gap(protrusion)
    angle, area = _contact(left)
    lowest = float(left.vertices[:, 2].min()) - LINK_Z
    return GripperCheck(
        min_width=min_width,
        max_width=max_width,
        needed_width=BLOCK + PLAY,
        contact_drive_joint=drive_joint_at(0.0, protrusion),
        block_drive_joint=drive_joint_at(BLOCK, protrusion),
        contact_angle=angle,
        contact_area=area,
        palm_clearance=float(link_origin(0.0)[1]) + lowest - PALM_Z,
        knuckle_clearance=_knuckle_clearance(left, depth),
    )


def _contact(left: TriangleMesh) -> tuple[float, float]:
    """Angle of the contact face [rad] and its area along the closing direction [m^2]."""
    corners = left.vertices[left.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    front = left.vertices[:, 1].min() + CONTACT_LAYER
    touching = (corners[:, :, 1].mean(axis=1) < front) & (normals[:, 1] < 0)
    mean = normals[touching].sum(axis=0)
    return float(np.arctan2(np.hypot(mean[0], mean[2]), -mean[1])), float(-mean[1])


def _knuckle_clearance(left: TriangleMesh, depth: float) -> float:
    corners = left.vertices[left.faces]
    points = np.concatenate([left.vertices, corners.mean(axis=1)])
    points = points[np.abs(points[:, 0]) < KNUCKLE_HALF_WIDTH + CLEARANCE]
    in_link = points[:, 1:] - [MOUNT_FACE + depth, LINK_Z]
    distances = [_segment_distance(in_link, *segment).min() for segment in knuckle_sweep()]
    return float(min(distances)) - KNUCKLE_RADIUS


def _segment_distance(
    points: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]
) -> NDArray[np.float64]:
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)
