"""Signed distances of a finger on a regular grid, as an npz file for simulators."""

from dataclasses import dataclass
from io import BytesIO

import igl
import numpy as np
from numpy.typing import NDArray

from codesign_design.columns import Columns, winding_numbers
from codesign_design.finger_pair import TriangleMesh

SPACING = 0.001  # m
_MARGIN = 0.003  # m around the surface


@dataclass(frozen=True)
class DistanceGrid:
    """Distances on a regular grid.

    Attributes:
        origin: (3,) the first point [m].
        spacing: between points [m].
        values: (nz, ny, nx) [m], negative inside.
    """

    origin: NDArray[np.float64]
    spacing: float
    values: NDArray[np.float32]

    def mirrored_y(self) -> "DistanceGrid":
        """Of the mirror image across the plane y = 0."""
        x, y, z = self.origin
        last = y + (self.values.shape[1] - 1) * self.spacing
        return DistanceGrid(np.array([x, -last, z]), self.spacing, self.values[:, ::-1])

    def npz(self) -> bytes:
        """npz with `origin` (3,), `spacing`, `values` (nz, ny, nx, x fastest) and `unit`, "m"."""
        buffer = BytesIO()
        np.savez_compressed(
            buffer, origin=self.origin, spacing=self.spacing, values=self.values, unit="m"
        )
        return buffer.getvalue()


def distance_grid(mesh: TriangleMesh, spacing: float = SPACING) -> DistanceGrid:
    """Signed distances of a closed surface, a margin of 3 mm around it included."""
    low, high = mesh.vertices.min(axis=0) - _MARGIN, mesh.vertices.max(axis=0) + _MARGIN
    axes = [np.arange(a, b + spacing, spacing) for a, b in zip(low, high, strict=True)]
    inside = winding_numbers(mesh, Columns(2, axes[0], axes[1]), axes[2]) > 0
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    squared, _, _ = igl.point_mesh_squared_distance(
        points.reshape(-1, 3), mesh.vertices, mesh.faces.astype(np.int64)
    )
    distance = np.sqrt(squared).reshape(inside.shape) * np.where(inside, -1.0, 1.0)
    return DistanceGrid(low, spacing, distance.T.astype(np.float32))
