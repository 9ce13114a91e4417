"""Flat gripping pads with rounded edges, by a handful of dimensions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from codesign_sim.checks import require_finite, require_positive
from codesign_sim.mesh import SurfaceMesh

DEPTH = 0.01  # m, from the face to the back
_FILLET_POINTS = 5


@dataclass(frozen=True)
class Parameter:
    """A dimension to vary.

    Attributes:
        name: of the argument of `flat_pads`.
        value, step: where to differentiate and by what difference, m or rad.
        scale, unit: for people: `value / scale` is in `unit`.
    """

    name: str
    value: float
    step: float
    scale: float
    unit: str


# A flat pad of the xArm stock finger's size, in the order of `flat_pads`. Steps reach over
# the unevenness that contact points and the 1 mm distance grid leave at 2,400 tetrahedra.
PARAMETERS = (
    Parameter("width", 0.0295, 2e-3, 1e-3, "mm"),
    Parameter("height", 0.0375, 2e-3, 1e-3, "mm"),
    Parameter("edge radius", 0.0015, 0.5e-3, 1e-3, "mm"),
    Parameter("offset", 0.0, 2e-3, 1e-3, "mm"),
    Parameter("tilt", 0.0, np.radians(0.5), np.radians(1), "deg"),
)


def flat_pads(
    width: float,
    height: float,
    edge_radius: float = 0.0007,
    offset: float = 0.0,
    tilt: float = 0.0,
) -> tuple[SurfaceMesh, SurfaceMesh]:
    """A mirrored (left, right) pair in the grasp frame at gap 0, the face's centre at y = 0.

    Args:
        width, height: of the whole pad, along x and z, metres.
        edge_radius: of the fillet around the face, metres, less than half the smaller side.
        offset: of the pad's centre along the approach, metres.
        tilt: of the face about x, radians; positive opens the fingers towards their tips.
    Raises:
        ValueError: a size that is not above 0, a fillet that leaves no flat face.
    """
    for name, value in (("width", width), ("height", height), ("edge radius", edge_radius)):
        require_positive(f"pad {name}", value, (), "m")
    require_finite("pad offset", offset, (), "m")
    require_finite("pad tilt", tilt, (), "rad")
    if 2 * edge_radius >= min(width, height, 2 * DEPTH):
        raise ValueError(
            f"pad edge radius is {edge_radius:g} m; it must be below half of width and height and "
            f"below {DEPTH:g} m: use less"
        )
    angles = np.linspace(0, np.pi / 2, _FILLET_POINTS)
    inset = np.append(edge_radius * (1 - np.cos(angles)), 0.0)
    y = np.append(edge_radius * (1 - np.sin(angles)), DEPTH)
    corners = [
        np.column_stack([sx * (width / 2 - inset), y, sz * (height / 2 - inset)])
        for sx in (1, -1)
        for sz in (1, -1)
    ]
    cos, sin = np.cos(tilt), np.sin(tilt)
    turn = np.array([[1, 0, 0], [0, cos, sin], [0, -sin, cos]])
    vertices = np.concatenate(corners) @ turn.T + np.array([0, 0, offset])
    hull = trimesh.convex.convex_hull(vertices)
    left = SurfaceMesh(hull.vertices, hull.faces)
    return left, SurfaceMesh(hull.vertices * np.array([1, -1, 1]), hull.faces[:, ::-1])
