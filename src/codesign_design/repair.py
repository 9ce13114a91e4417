"""A valid surface from a deformed one that may cut through itself.

The solid is where the winding number is positive: overlaps merge, and parts turned inside out
vanish. It is sampled on a regular grid, with distances to the surface only where the sign changes,
and meshed by marching cubes; Taubin smoothing (1995) removes the grid's steps without shrinking.
The paper (section III-A) reconstructs from a sampled point cloud to the same end: `poisson.py`.
"""

from dataclasses import dataclass

import igl
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_matrix, diags
from skimage.measure import marching_cubes

from codesign_design.columns import Columns, winding_numbers
from codesign_design.finger_pair import TriangleMesh
from codesign_design.mesh_checks import edge_checks, face_components, volume_and_centre
from codesign_design.solid import to_solid, to_surface

VOXEL = 0.001  # m; sheets thinner than this may be lost
MAX_POINTS = 4_000_000  # of the grid; a larger surface gets a coarser one
_MARGIN = 2.37  # voxels around the surface; odd, to keep columns off the vertices
_FLATTER, _INFLATE = 0.5, -0.53  # Taubin's two steps
_THINNING = 0.03  # mm, largest change when vertices are taken out
_LEAST_DISTANCE = 0.02  # voxels; keeps marching cubes from making slivers


@dataclass(frozen=True)
class Repaired:
    """A remeshed surface.

    Attributes:
        mesh: watertight and in one piece, not yet smoothed.
        voxel: of the grid [m].
        volume: of the sampled solid, voxels counted [m^3].
        lost: volume of smaller, separate pieces that were dropped, as a fraction of all.
    """

    mesh: TriangleMesh
    voxel: float
    volume: float
    lost: float


def repair(surface: TriangleMesh, depth: float = np.inf, voxel: float = VOXEL) -> Repaired:
    """The largest piece of the solid inside a surface, cavities filled.

    Args:
        surface: closed or not; with holes, the generalised winding number decides.
        depth: what lies further than this behind the most protruding point, along y, is left
            out [m]: it is cut off at the mount anyway.
        voxel: grid spacing [m].

    Raises:
        ValueError: no solid is left, for example because the surface is inside out.
    """
    axes, voxel = grid_axes(surface, voxel)
    solid, lost = one_piece(surface, _winding(surface, axes) > 0.5, axes, depth, voxel)
    volume = int(solid.sum()) * voxel**3
    return Repaired(_mesh(surface, solid, axes, voxel), voxel, volume, lost)


def grid_axes(
    surface: TriangleMesh, voxel: float, margin: float = _MARGIN
) -> tuple[list[NDArray[np.float64]], float]:
    """Coordinates of a grid around the surface along x, y, z, and its spacing, coarser if need be.

    Args:
        surface: to be covered.
        voxel: wanted spacing [m].
        margin: around it [voxels].
    """
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    size = high - low + 2 * margin * voxel
    voxel = max(voxel, float(np.cbrt(size.prod() / MAX_POINTS)))
    axes = [
        np.arange(a - margin * voxel, b + margin * voxel, voxel)
        for a, b in zip(low, high, strict=True)
    ]
    return axes, voxel


def one_piece(
    surface: TriangleMesh,
    solid: NDArray[np.bool_],
    axes: list[NDArray[np.float64]],
    depth: float,
    voxel: float,
) -> tuple[NDArray[np.bool_], float]:
    """The largest piece of sampled solid, cut at `depth`, cavities filled; the share that is lost.

    Cuts `axes[1]` to the length that is left.

    Raises:
        ValueError: there is no solid.
    """
    total = int(solid.sum())
    solid = _largest(solid)
    if not solid.any():
        volume = volume_and_centre(surface)[0] * 1e9
        raise ValueError(
            f"the surface encloses no solid of more than {voxel * 1e3:g} mm (signed volume "
            f"{volume:.1f} mm^3); turn its faces outward or make it thicker"
        )
    lost = 1.0 - int(solid.sum()) / total
    front = int(np.flatnonzero(solid.any(axis=(0, 2)))[0])
    size = np.ptp(axes[1])
    last = front + int(np.ceil(min(depth, size) / voxel)) + 2
    solid, axes[1] = solid[:, : last + 1], axes[1][: last + 1]
    solid[:, -1] = False
    return ndimage.binary_fill_holes(_largest(solid)), lost


def smoothed(surface: TriangleMesh, iterations: int) -> TriangleMesh:
    """Taubin smoothing, each iteration flattens, then inflates; then needless vertices go."""
    faces, count = surface.faces, len(surface.vertices)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    neighbours = coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count)).tocsr()
    average = diags(1.0 / np.maximum(neighbours.sum(axis=1).A1, 1.0)) @ neighbours
    vertices = surface.vertices.copy()
    for step in (_FLATTER, _INFLATE) * iterations:
        vertices += step * (average @ vertices - vertices)
    return to_surface(to_solid(TriangleMesh(vertices, faces)).simplify(_THINNING))


def _winding(surface: TriangleMesh, axes: list[NDArray[np.float64]]) -> NDArray[np.number]:
    if all(edge_checks(surface.faces)):
        return winding_numbers(surface, Columns(2, axes[0], axes[1]), axes[2])
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    winding = igl.fast_winding_number(
        surface.vertices, surface.faces.astype(np.int64), points.reshape(-1, 3)
    )
    return winding.reshape(points.shape[:3])


def _largest(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest piece connected through the faces of voxels."""
    labels, count = ndimage.label(solid)
    if count < 2:
        return solid
    return labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))


def _mesh(
    surface: TriangleMesh,
    solid: NDArray[np.bool_],
    axes: list[NDArray[np.float64]],
    voxel: float,
) -> TriangleMesh:
    """Marching cubes on the distance to the surface, known where the solid begins."""
    border = np.zeros_like(solid)
    for axis in range(3):
        here = [slice(None)] * 3
        here[axis] = slice(None, -1)
        there = [slice(None)] * 3
        there[axis] = slice(1, None)
        change = solid[tuple(here)] != solid[tuple(there)]
        border[tuple(here)] |= change
        border[tuple(there)] |= change
    index = np.nonzero(border)
    points = np.stack([axis[i] for axis, i in zip(axes, index, strict=True)], axis=1)
    squared, _, _ = igl.point_mesh_squared_distance(
        points, surface.vertices, surface.faces.astype(np.int64)
    )
    distance = np.ones(solid.shape)
    distance[index] = np.clip(np.sqrt(squared) / voxel, _LEAST_DISTANCE, 1.0)
    return piece_of_level(np.where(solid, -distance, distance), axes, voxel)


def piece_of_level(
    field: NDArray[np.float64], axes: list[NDArray[np.float64]], voxel: float
) -> TriangleMesh:
    """The largest piece of the surface around where a sampled field is negative."""
    vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="descent")
    corner = np.array([axis[0] for axis in axes])
    mesh = TriangleMesh(corner + vertices.astype(np.float64) * voxel, faces.astype(np.int32))
    return _largest_component(mesh)


def _largest_component(surface: TriangleMesh) -> TriangleMesh:
    labels, count = face_components(surface.faces)
    if count < 2:
        return surface
    faces = surface.faces[labels == np.argmax(np.bincount(labels))]
    used, local = np.unique(faces, return_inverse=True)
    return TriangleMesh(surface.vertices[used], local.reshape(-1, 3).astype(np.int32))
