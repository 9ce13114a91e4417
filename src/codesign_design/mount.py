"""Fastening a finger body to the stock finger link: mount "stock-m3x2".

A boss with the stock finger's mount face carries two M3 socket head screws along the closing
direction. They are put in from the contact side, through channels as wide as their heads. Numbers
are millimetres in the finger link's frame: face y = -19, x +-8, z 21..53, holes on x = 0.
"""

from dataclasses import dataclass

import igl
import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from numpy.typing import NDArray

from codesign_design.columns import Columns, crossings
from codesign_design.finger_pair import MOUNT_FACE, TriangleMesh
from codesign_design.gripper_geometry import (
    KNUCKLE_HALF_WIDTH,
    KNUCKLE_RADIUS,
    knuckle_sweep,
)
from codesign_design.solid import MM, TOLERANCE, to_solid, to_surface
from codesign_design.stock import DEPTH, LINK_Z

NAME = "stock-m3x2"
HALF_WIDTH = 8.0  # mm, x
BOTTOM, TOP = 21.0, 53.0  # mm, z in the finger link
HOLES = (31.0, 43.0)  # mm, z in the finger link
HOLE_DIAMETER = 3.2  # mm, clearance of M3
HEAD_DIAMETER = 5.5  # mm, counterbore and the screwdriver's channel before it
WEB = 2.5  # mm, under the screw's head
BOSS_DEPTH = 5.8  # mm: the web, a head 3 mm high, and a little rest

MAX_DEPTH = 0.020  # m; such fingers still open by 58 mm, see `gripper_check`

_OVERLAP = 1.0  # mm, of boss and body
_WIDE = 1e3  # mm, wider than any finger
_CELL = 1.0  # mm, of the boss's fit to the body behind it
_LEAST_SHARE = 0.2  # of the boss's footprint with body in front of it, else a bridge is needed
_BRIDGE_GRID = 25  # columns either way, to find the body's thickest part
_SEGMENTS = 40  # of a circle


@dataclass(frozen=True)
class Mounted:
    """A body on its mount.

    Attributes:
        mesh: left finger in the grasp frame, most protruding point at y = 0 [m].
        depth: from there to the mount face [m].
        bridged: a bridge was needed to reach the boss.
        lost: volume cut loose by mount and channels, as a fraction of all.
    """

    mesh: TriangleMesh
    depth: float
    bridged: bool
    lost: float


def mount_finger(body: TriangleMesh) -> Mounted:
    """Unites a body with the boss, cuts the holes and what the gripper's own parts need.

    Args:
        body: valid surface, left finger in the grasp frame, contact side at y = 0.

    Raises:
        ValueError: the body encloses no solid.
    """
    front = float(body.vertices[:, 1].min())
    body = TriangleMesh(body.vertices - [0.0, front, 0.0], body.faces)
    found = _slabs(body, _footprint(), min(float(body.vertices[:, 1].max()), MAX_DEPTH) * MM)
    depth = _depth(body, found)
    hit = np.isfinite(found).all(axis=-1)
    bridged = bool(hit.mean() < _LEAST_SHARE)
    parts = [to_solid(body), _boss(found, depth)]
    if bridged:
        parts.append(_bridge(body, depth))
    united = Manifold.batch_boolean(parts, OpType.Add)
    cut = Manifold.batch_boolean([united, *_cuts(depth)], OpType.Subtract)
    finger, lost = _piece_with_boss(cut.set_tolerance(TOLERANCE), depth)
    finger = finger.translate((0.0, -finger.bounding_box()[1], 0.0))
    return Mounted(to_surface(finger), finger.bounding_box()[4] / MM, bridged, lost)


def grasp_z(link_z: float) -> float:
    """z in the grasp frame of a z in the finger link, both mm."""
    return link_z + LINK_Z * MM


def _footprint() -> Columns:
    """Columns through the boss, along y [m]."""
    z = np.linspace(grasp_z(BOTTOM), grasp_z(TOP), round((TOP - BOTTOM) / _CELL) + 1)
    x = np.linspace(-HALF_WIDTH, HALF_WIDTH, round(2 * HALF_WIDTH / _CELL) + 1)
    return Columns(1, z / MM, x / MM)


def _slabs(body: TriangleMesh, columns: Columns, back: float) -> NDArray[np.float64]:
    """Front and back of the body's last layer before `back`, (Z, X, 2) [mm]; NaN for none."""
    found = crossings(body, columns)
    height = found.height * MM
    front, rear = np.full(columns.count, -np.inf), np.full(columns.count, np.inf)
    enters = (found.sign < 0) & (height < back)
    np.maximum.at(front, found.column[enters], height[enters])
    leaves = (found.sign > 0) & (height > front[found.column])
    np.minimum.at(rear, found.column[leaves], height[leaves])
    slabs = np.stack([front, np.minimum(rear, back)], axis=-1)
    slabs[~np.isfinite(front)] = np.nan
    return slabs.reshape(len(columns.first), len(columns.second), 2)


def _depth(body: TriangleMesh, slabs: NDArray[np.float64]) -> float:
    """Mount face behind the most protruding point [mm].

    Deep enough that the boss stays behind the body's contact side, but not deeper than the
    opening allows: what reaches further back is cut off.
    """
    back = float(body.vertices[:, 1].max()) * MM
    front = np.nanmax(slabs[..., 0], initial=-np.inf)
    return min(max(DEPTH * MM, back, front + BOSS_DEPTH), MAX_DEPTH * MM)


def _boss(slabs: NDArray[np.float64], depth: float) -> Manifold:
    """The boss, extended forward until it is inside the body wherever there is body before it.

    It ends a little behind the mount face, which is cut later.
    """
    front, back = slabs[..., 0], slabs[..., 1]
    reach = back - np.minimum(_OVERLAP, (back - front) / 2.0)
    reach = np.minimum(np.where(np.isnan(reach), np.inf, reach), depth - BOSS_DEPTH)
    columns = _footprint()
    z, x = np.meshgrid(columns.first * MM, columns.second * MM, indexing="ij")
    count = z.size
    index = np.arange(count).reshape(z.shape)
    corners = [index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]]
    a, b, c, d = (corner.ravel() for corner in corners)
    front_faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    after = np.roll(rim, -1)
    walls = [
        np.column_stack([rim, rim + count, after + count]),
        np.column_stack([rim, after + count, after]),
    ]
    faces = np.concatenate([front_faces, front_faces[:, ::-1] + count, *walls])
    points = [
        np.column_stack([x.ravel(), y.ravel(), z.ravel()])
        for y in (reach, np.full(z.shape, depth + _OVERLAP))
    ]
    return to_solid(TriangleMesh(np.concatenate(points) / MM, faces.astype(np.int32)))


def _bridge(body: TriangleMesh, depth: float) -> Manifold:
    """Hull of the boss and of a ball in the thickest part of the body."""
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    z, x = (np.linspace(low[k], high[k], _BRIDGE_GRID + 2)[1:-1] for k in (2, 0))
    slabs = _slabs(body, Columns(1, z, x), depth - BOSS_DEPTH).reshape(-1, 2)
    points = np.stack(np.meshgrid(z, x, indexing="ij"), axis=-1).reshape(-1, 2)
    centres = np.column_stack([points[:, 1], slabs.mean(axis=1) / MM, points[:, 0]])
    centres = centres[np.isfinite(centres).all(axis=1)]
    squared, _, _ = igl.point_mesh_squared_distance(
        centres, body.vertices, body.faces.astype(np.int64)
    )
    best = int(np.argmax(squared))
    ball = Manifold.sphere(float(np.sqrt(squared[best])) * MM, _SEGMENTS)
    boss = Manifold.cube((2 * HALF_WIDTH, BOSS_DEPTH, TOP - BOTTOM))
    boss = boss.translate((-HALF_WIDTH, depth - BOSS_DEPTH, grasp_z(BOTTOM)))
    return Manifold.batch_hull([boss, ball.translate(tuple(centres[best] * MM))])


def _cuts(depth: float) -> list[Manifold]:
    """What is behind the mount face, screw holes with their channels, the knuckle's room."""
    behind = Manifold.cube((_WIDE, _WIDE, _WIDE)).translate((-_WIDE / 2, depth, -_WIDE / 2))
    cuts = [behind, _knuckle_room(depth)]
    for z in HOLES:
        for diameter, end in ((HOLE_DIAMETER, depth + 1.0), (HEAD_DIAMETER, depth - WEB)):
            cylinder = Manifold.cylinder(end + 1.0, diameter / 2.0, -1.0, _SEGMENTS)
            cuts.append(cylinder.rotate((-90.0, 0.0, 0.0)).translate((0.0, -1.0, grasp_z(z))))
    return cuts


def _knuckle_room(depth: float) -> Manifold:
    """The inner knuckle's path in the finger's frame, over the whole drive."""
    circle = CrossSection.circle(KNUCKLE_RADIUS * MM, _SEGMENTS)
    points = np.unique(knuckle_sweep().reshape(-1, 2), axis=0) * MM
    swept = CrossSection.batch_hull([circle.translate(tuple(point)) for point in points])
    half = KNUCKLE_HALF_WIDTH * MM
    room = swept.extrude(2 * half)
    # Extruded along z; its (y, z) outline is in the extrusion's x and y.
    place = [[0, 0, 1, -half], [1, 0, 0, MOUNT_FACE * MM + depth], [0, 1, 0, LINK_Z * MM]]
    return room.transform(place)


def _piece_with_boss(solid: Manifold, depth: float) -> tuple[Manifold, float]:
    """The largest piece that reaches the mount face, and the share of volume it leaves behind."""
    pieces = solid.decompose()
    mounted = [p for p in pieces if p.bounding_box()[4] > depth - 1e-3]
    largest = max(mounted, key=lambda p: p.volume())
    return largest, 1.0 - largest.volume() / solid.volume()
