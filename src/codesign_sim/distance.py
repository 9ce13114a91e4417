"""Signed distance grids of finger surfaces, baked once per shape and kept on disk."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from codesign_sim import disk_cache
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.surface_queries import BAND, SurfaceQueries, queries_of, spread_samples

SPACING = 1e-3  # metres; edges sharper than this are rounded to about it
# Metres; a soft block may pass through thinner walls. Contact pushes a point out to the nearest
# side, so a wall must be thicker than twice the depth (0.5 mm under a lip that carries the tofu)
# and a cell; below 1 mm the grid may not show it at all.
THINNEST = 2.5e-3
_VERSION = 1  # of what is baked; raise it whenever equal meshes would give another result
_MARGIN_CELLS = 2
_LARGEST = 20_000_000  # cells; 80 MB
_SAMPLE_SPACING = 0.7e-3  # metres, between the rays that look for thin walls
_OPPOSITE = -0.8  # cosine between the normals of a wall's two faces; edges up to 37 degrees
_ARRAYS = ("origin", "values", "thin_area", "thinnest", "thin_place")


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Distances (nz, ny, nx) in metres, negative inside; x fastest.

    Attributes:
        origin: (3,) metres, of the first value.
        spacing: metres.
        values: metres; exact within 3 mm of the surface, beyond that only growing.
        thin_area: surface in m^2 of walls thinner than `THINNEST`, both faces counted.
        thinnest: thickness in metres of the thinnest of them; infinite where there are none.
        thin_place: (3,) metres, where that is.
    """

    origin: np.ndarray
    spacing: float
    values: np.ndarray
    thin_area: float = 0.0
    thinnest: float = np.inf
    thin_place: np.ndarray | None = None

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


def bake(mesh: SurfaceMesh, spacing: float = SPACING) -> DistanceGrid:
    """The signed distance grid of a mesh.

    Equal meshes share one grid in memory, and one file in the user's cache (`disk_cache`).

    Raises:
        ValueError: a mesh so large that its grid would not fit in memory.
    """
    return _bake_cached(_ByContent(mesh), float(spacing))


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
    settings = (_VERSION, spacing, _MARGIN_CELLS, float(BAND), THINNEST)
    name = hashlib.sha256(f"{key.mesh.content_hash} {settings}".encode()).hexdigest()
    kept = disk_cache.load(name, _ARRAYS)
    if kept is not None:
        area, thinnest = float(kept["thin_area"]), float(kept["thinnest"])
        return DistanceGrid(
            kept["origin"], spacing, kept["values"], area, thinnest, kept["thin_place"]
        )
    grid = _bake(key.mesh, spacing)
    disk_cache.store(name, {array: np.asarray(getattr(grid, array)) for array in _ARRAYS})
    return grid


def _bake(mesh: SurfaceMesh, spacing: float) -> DistanceGrid:
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
    surface = queries_of(mesh)
    distance, side = surface.nearest(points)
    signed = _everywhere(side, distance.reshape(shape[::-1]), spacing, surface, points)
    thin = _thin_walls(mesh, surface)
    return DistanceGrid(low, spacing, signed.astype(np.float32), *thin)


def _everywhere(
    side: np.ndarray,
    distance: np.ndarray,
    spacing: float,
    surface: SurfaceQueries,
    points: np.ndarray,
) -> np.ndarray:
    """Signed distances, from the sides that are known.

    No surface passes between neighbours that are both farther than half a cell from it, so one
    point decides a whole connected region; only what is nearer is asked point by point.
    """
    region, _ = ndimage.label(distance > 0.501 * spacing)
    near = region.ravel() == 0
    regions, first = np.unique(region, return_index=True)
    side_of = np.zeros(regions.max() + 1)
    side_of[regions] = surface.sides(points[first])
    unsure = near & (side == 0)
    side = np.where(near, side, side_of[region].ravel())
    side[unsure] = surface.sides(points[unsure])
    return side.reshape(distance.shape) * _beyond_band(distance, spacing)


def _beyond_band(distance: np.ndarray, spacing: float) -> np.ndarray:
    """Fills distances beyond the band: that of the nearest point in it, and the way there."""
    beyond = distance >= BAND
    if not beyond.any():
        return distance
    way, nearest = ndimage.distance_transform_edt(beyond, sampling=spacing, return_indices=True)
    return np.where(beyond, distance[tuple(nearest)] + way, distance)


def _thin_walls(mesh: SurfaceMesh, surface: SurfaceQueries) -> tuple[float, float, np.ndarray]:
    """Area of walls thinner than `THINNEST`, their least thickness, and where that is.

    Thickness is measured along rays from the surface straight inwards, to a face that looks the
    other way: the sharp edge of a block is not a wall, that of a knife is.
    """
    points, face = spread_samples(mesh, _SAMPLE_SPACING)
    normals = mesh.normals_by_area / np.linalg.norm(mesh.normals_by_area, axis=1, keepdims=True)
    skin = 1e-6  # metres, to leave the face itself behind
    inwards = -normals[face]
    thickness, behind = surface.first_hits(points + skin * inwards, inwards, THINNEST - 2 * skin)
    facing = np.einsum("ij,ij->i", normals[face], normals[behind])
    thin = (behind >= 0) & (facing < _OPPOSITE)
    if not thin.any():
        return 0.0, np.inf, np.zeros(3)
    at = np.flatnonzero(thin)[np.argmin(thickness[thin])]
    return float(thin.mean() * mesh.area), float(thickness[at] + skin), points[at]
