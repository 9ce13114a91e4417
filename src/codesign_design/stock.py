"""The stock finger of the xArm gripper G1: the baseline of every comparison.

Measured from the manufacturer's published mesh (finger-link frame, millimetres): a flat pad
29.5 wide and 37.5 tall at y = -26 around z = 41, standing 2 proud of a 32 x 46 frame at y = -24;
the mount face at y = -19. The edges are nearly sharp; their radius is taken as 0.7.
"""

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair, TriangleMesh

PAD_WIDTH = 0.0295  # m
PAD_HEIGHT = 0.0375  # m
PAD_PROUD = 0.002  # m, pad face to frame face
FRAME_WIDTH = 0.032  # m
FRAME_HEIGHT = 0.046  # m
DEPTH = 0.007  # m, pad face to mount face
EDGE_RADIUS = 0.0007  # m
OUTLINE_RADIUS = 0.0015  # m, corners of both outlines seen from the front
CENTRE_Z_IN_LINK = 0.041  # m, finger-link frame

# The finger link's z in the grasp frame: the four-bar of the gripper puts the link 0.113487 m from
# the flange at its closed end, and the tool centre point is at 0.172 m.
LINK_Z = 0.113487 - 0.172  # m

STROKE = 0.084  # m, the gripper's full opening by its manual

_CORNER_POINTS = 4
_FILLET_POINTS = 4


def stock_fingers(edge_radius: float = EDGE_RADIUS) -> FingerPair:
    """The stock finger pair in the grasp frame.

    Args:
        edge_radius: fillet along the edges of pad and frame [m], within (0, 0.0015).

    Raises:
        ValueError: edge radius outside that range.
    """
    if not 0.0 < edge_radius < OUTLINE_RADIUS:
        raise ValueError(
            f"edge radius {edge_radius} m: must be within (0, {OUTLINE_RADIUS}) m, the radius of "
            "the outline's corners"
        )
    left = _loft(_profile(edge_radius))
    return FingerPair("stock", left, left.mirrored_y(), 0.0, STROKE, mount="stock-m3x2")


def _profile(radius: float) -> list[tuple[float, float, float]]:
    """From the mount face to the pad face: (y, inset, 0 frame or 1 pad) of each outline."""
    angles = np.linspace(0.0, np.pi / 2.0, _FILLET_POINTS)

    def fillet(y_face: float, outline: float) -> list[tuple[float, float, float]]:
        return [
            (y_face + radius * (1.0 - np.sin(a)), radius * (1.0 - np.cos(a)), outline)
            for a in angles
        ]

    return [
        (DEPTH, 0.0, 0.0),
        *fillet(PAD_PROUD, 0.0),
        (PAD_PROUD, 0.0, 1.0),
        *fillet(0.0, 1.0),
    ]


def _outline(width: float, height: float, inset: float) -> NDArray[np.float64]:
    """A rounded rectangle in x, z, (4 * corner points, 2), clockwise seen from +y."""
    radius = OUTLINE_RADIUS - inset
    half = np.array([width, height]) / 2.0 - inset - radius
    points = []
    for quarter in range(4):
        angles = np.pi / 2.0 * (quarter + np.linspace(0.0, 1.0, _CORNER_POINTS))
        sign = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])[quarter]
        points.append(sign * half + radius * np.column_stack([np.cos(angles), np.sin(angles)]))
    return np.concatenate(points)


def _loft(profile: list[tuple[float, float, float]]) -> TriangleMesh:
    """Joins the outlines to one closed surface, with a fan of triangles on either end."""
    sizes = {0.0: (FRAME_WIDTH, FRAME_HEIGHT), 1.0: (PAD_WIDTH, PAD_HEIGHT)}
    z_centre = CENTRE_Z_IN_LINK + LINK_Z
    rings = []
    for y, inset, outline in profile:
        xz = _outline(*sizes[outline], inset)
        rings.append(np.column_stack([xz[:, 0], np.full(len(xz), y), xz[:, 1] + z_centre]))
    count = len(rings[0])
    i = np.arange(count)
    j = (i + 1) % count
    faces = [_ring(k * count + i, k * count + j, count) for k in range(len(rings) - 1)]
    first_centre = len(rings) * count
    last = first_centre - count
    faces.append(np.column_stack([j, i, np.full(count, first_centre)]))
    faces.append(np.column_stack([last + i, last + j, np.full(count, first_centre + 1)]))
    centres = [ring.mean(axis=0) for ring in (rings[0], rings[-1])]
    vertices = np.concatenate([*rings, centres])
    return TriangleMesh(vertices, np.concatenate(faces).astype(np.int32))


def _ring(i: NDArray[np.int_], j: NDArray[np.int_], count: int) -> NDArray[np.int_]:
    """Two triangles for each quad between an outline and the next one."""
    return np.concatenate(
        [np.column_stack([i, j, j + count]), np.column_stack([i, j + count, i + count])]
    )
