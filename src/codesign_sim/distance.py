"""Signed distance grids of finger surfaces, baked once per shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import warp as wp
from scipy import ndimage

import codesign_sim.kernels  # noqa: F401  (makes Warp quiet before its first use)
from codesign_sim.mesh import SurfaceMesh

SPACING = 1e-3  # metres; edges sharper than this are rounded to about it
_MARGIN_CELLS = 2
# Metres; distances are exact in cells within it, that is to 1.3 mm deep, which no grasp reaches.
BAND = wp.constant(3e-3)
_LARGEST = 20_000_000  # cells; 80 MB

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Distances (nz, ny, nx) in metres, negative inside; x fastest."""

    origin: np.ndarray
    spacing: float
    values: np.ndarray

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Trilinear distance (M,) at points (M, 3); +inf outside the grid."""
        shape = np.array(self.values.shape[::-1])
        u = (np.asarray(points) - self.origin) / self.spacing
        inside = ((u >= 0) & (u < shape - 1)).all(axis=1)
        i = np.where(inside[:, None], u, 0).astype(int)
        t = np.where(inside[:, None], u - i, 0)
        result = np.zeros(len(u))
        for corner in range(8):
            bit = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            x, y, z = (i + bit).T
            weight = np.where(bit, t, 1 - t).prod(axis=1)
            result += weight * self.values[z, y, x]
        return np.where(inside, result, np.inf)


@wp.kernel
def _nearest(
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    distance: wp.array[wp.float32],
    side: wp.array[wp.float32],
):
    """Distance up to the band, and the side (-1 inside, 1 outside) where the nearest point tells.

    It does if it lies within a face; the normals at an edge or a corner may point either way.
    """
    i = wp.tid()
    hit = wp.mesh_query_point_no_sign(mesh, points[i], BAND)
    distance[i] = BAND  # type: ignore
    side[i] = 0.0  # type: ignore
    if hit.result:  # type: ignore
        way = points[i] - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)  # type: ignore
        distance[i] = wp.length(way)  # type: ignore
        if wp.min(wp.min(hit.u, hit.v), 1.0 - hit.u - hit.v) > 1.0e-3:  # type: ignore
            side[i] = wp.sign(wp.dot(way, wp.mesh_eval_face_normal(mesh, hit.face)))  # type: ignore


@wp.kernel
def _side(mesh: wp.uint64, points: wp.array[wp.vec3], side: wp.array[wp.float32]):
    """The side by winding number, right everywhere but ten times as slow."""
    i = wp.tid()
    hit = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e6)
    side[i] = hit.sign  # type: ignore


def bake(mesh: SurfaceMesh, spacing: float = SPACING) -> DistanceGrid:
    """The signed distance grid of a mesh; equal meshes share one grid in memory.

    Raises:
        ValueError: a mesh so large that its grid would not fit in memory.
    """
    return _bake_cached(_ByContent(mesh), spacing)


class _ByContent:
    """A mesh that compares by its content."""

    def __init__(self, mesh: SurfaceMesh) -> None:
        self.mesh = mesh

    def __hash__(self) -> int:
        return hash(self.mesh.content_hash)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByContent) and self.mesh.content_hash == other.mesh.content_hash


@lru_cache(maxsize=64)
def _bake_cached(key: _ByContent, spacing: float) -> DistanceGrid:
    mesh = key.mesh
    low = mesh.vertices.min(axis=0) - _MARGIN_CELLS * spacing
    shape = np.ceil((mesh.vertices.max(axis=0) - low) / spacing).astype(int) + 1 + _MARGIN_CELLS
    if shape.prod() > _LARGEST:
        raise ValueError(
            f"finger mesh measures {np.ptp(mesh.vertices, axis=0)} m, a grid of {shape.prod()} "
            f"cells of {spacing:g} m; the limit is {_LARGEST}: is the mesh in metres?"
        )
    axes = [low[k] + spacing * np.arange(shape[k]) for k in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    surface = wp.Mesh(
        points=wp.array(mesh.vertices, dtype=wp.vec3, device="cpu"),
        indices=wp.array(mesh.faces.ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    distance, side = _query(_nearest, surface, points, results=2)
    signed = _everywhere(side, distance.reshape(shape[::-1]), spacing, surface, points)
    return DistanceGrid(low, spacing, signed.astype(np.float32))


def _query(
    kernel: wp.Kernel, surface: wp.Mesh, points: np.ndarray, results: int = 1
) -> list[np.ndarray]:
    """What a kernel finds at each point."""
    found = [wp.zeros(len(points), dtype=wp.float32, device="cpu") for _ in range(results)]
    where: wp.array = wp.array(points, dtype=wp.vec3, device="cpu")
    wp.launch(kernel, dim=len(points), inputs=[surface.id, where, *found], device="cpu")
    return [array.numpy() for array in found]


def _everywhere(
    side: np.ndarray, distance: np.ndarray, spacing: float, surface: wp.Mesh, points: np.ndarray
) -> np.ndarray:
    """Signed distances, from the sides that are known.

    No surface passes between neighbours that are both farther than half a cell from it, so one
    point decides a whole connected region; only what is nearer is asked point by point.
    """
    region, _ = ndimage.label(distance > 0.501 * spacing)
    near = region.ravel() == 0
    regions, first = np.unique(region, return_index=True)
    side_of = np.zeros(regions.max() + 1)
    side_of[regions] = _query(_side, surface, points[first])[0]
    unsure = near & (side == 0)
    side = np.where(near, side, side_of[region].ravel())
    side[unsure] = _query(_side, surface, points[unsure])[0]
    return side.reshape(distance.shape) * _beyond_band(distance, spacing)


def _beyond_band(distance: np.ndarray, spacing: float) -> np.ndarray:
    """Fills distances beyond the band: that of the nearest point in it, and the way there."""
    beyond = distance >= BAND
    if not beyond.any():
        return distance
    way, nearest = ndimage.distance_transform_edt(beyond, sampling=spacing, return_indices=True)
    return np.where(beyond, distance[tuple(nearest)] + way, distance)
