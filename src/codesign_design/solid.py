"""Surfaces as solids of the boolean kernel, which works in millimetres."""

import numpy as np
from manifold3d import Error, Manifold, Mesh64

from codesign_design.finger_pair import TriangleMesh

MM = 1e3  # millimetres per metre
TOLERANCE = 1e-3  # mm; finer detail is merged, so that single-precision files stay watertight


def to_solid(surface: TriangleMesh) -> Manifold:
    """The solid inside a closed surface.

    Raises:
        ValueError: the surface is not a closed, consistently wound manifold.
    """
    solid = Manifold(Mesh64(surface.vertices * MM, surface.faces.astype(np.uint64)))
    if solid.status() != Error.NoError or solid.is_empty():
        raise ValueError(
            f"the surface does not enclose a solid ({solid.status().name}); repair it first"
        )
    return solid


def to_surface(solid: Manifold) -> TriangleMesh:
    """The solid's surface [m]."""
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties[:, :3], dtype=np.float64) / MM
    return TriangleMesh(vertices, np.array(mesh.tri_verts, dtype=np.int32))
