"""Signed distances of a finger on a regular grid, as an npz file for simulators."""

from io import BytesIO

import igl
import numpy as np
from numpy.typing import NDArray

from codesign_design.columns import Columns, winding_numbers
from codesign_design.finger_pair import TriangleMesh

SPACING = 0.001  # m
_MARGIN = 0.003  # m around the surface


def distance_grid(
    mesh: TriangleMesh, spacing: float = SPACING
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """The grid's first point (3,) [m] and distances (nz, ny, nx) [m], negative inside."""
    low, high = mesh.vertices.min(axis=0) - _MARGIN, mesh.vertices.max(axis=0) + _MARGIN
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    inside = winding_numbers(mesh, Columns(2, axes[0], axes[1]), axes[2]) > 0
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    squared, _, _ = igl.point_mesh_squared_distance(
        points.reshape(-1, 3), mesh.vertices, mesh.faces.astype(np.int64)
    )
    distance = np.sqrt(squared).reshape(inside.shape) * np.where(inside, -1.0, 1.0)
    return np.array([axis[0] for axis in axes]), distance.T.astype(np.float32)


def npz_bytes(mesh: TriangleMesh, spacing: float = SPACING) -> bytes:
    """npz with `origin` (3,), `spacing`, `values` (nz, ny, nx, x fastest) and `unit`, "m"."""
    origin, values = distance_grid(mesh, spacing)
    buffer = BytesIO()
    np.savez_compressed(buffer, origin=origin, spacing=spacing, values=values, unit="m")
    return buffer.getvalue()
