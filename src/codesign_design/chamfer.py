"""How alike two closed surfaces are: two-way Chamfer distance and volume overlap."""

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray

from codesign_design.columns import Columns, winding_numbers
from codesign_design.finger_pair import TriangleMesh


def sample_surface(
    mesh: TriangleMesh, count: int, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points uniform over the surface and the normals there, both (count, 3)."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, faces = trimesh.sample.sample_surface(surface, count, seed=seed)
    return np.asarray(points), np.asarray(surface.face_normals)[faces]


def distances_to(points: NDArray[np.float64], mesh: TriangleMesh) -> NDArray[np.float64]:
    """Distance of each of (P, 3) points to the nearest point of the surface [m]."""
    squared, _, _ = igl.point_mesh_squared_distance(
        points, mesh.vertices, mesh.faces.astype(np.int64)
    )
    return np.sqrt(squared)


def chamfer_distance(
    a: TriangleMesh, b: TriangleMesh, samples: int = 20_000, seed: int = 0
) -> float:
    """Mean of the two directed mean distances between the surfaces [m].

    Samples of each surface are measured to the other surface itself, not to its samples, so the
    distance of a surface to itself is zero whatever the number of samples.
    """
    to_b = distances_to(sample_surface(a, samples, seed)[0], b)
    to_a = distances_to(sample_surface(b, samples, seed + 1)[0], a)
    return float(to_b.mean() + to_a.mean()) / 2.0


def volume_iou(
    a: TriangleMesh,
    b: TriangleMesh,
    spacing: float = 0.7e-3,
    region: NDArray[np.float64] | None = None,
) -> float:
    """Intersection over union of the enclosed volumes, on a grid of points.

    Inside is where the winding number is positive, so folds of a self-intersecting surface count
    once.

    Args:
        spacing: between grid points [m].
        region: (2, 3) corners of a box [m]; only what lies within it counts.

    Raises:
        ValueError: neither body has a grid point in the region.
    """
    corners = np.concatenate([a.vertices, b.vertices])
    low, high = corners.min(axis=0), corners.max(axis=0)
    if region is not None:
        low, high = np.maximum(low, region[0]), np.minimum(high, region[1])
    axes = [
        np.arange(start, end, spacing) + spacing / 2 for start, end in zip(low, high, strict=True)
    ]
    columns = Columns(2, axes[0], axes[1])
    in_a, in_b = (winding_numbers(mesh, columns, axes[2]) > 0 for mesh in (a, b))
    union = np.count_nonzero(in_a | in_b)
    if union == 0:
        raise ValueError(
            f"neither body reaches into the region {low.tolist()} to {high.tolist()} m; "
            "choose one that the target occupies"
        )
    return float(np.count_nonzero(in_a & in_b) / union)
