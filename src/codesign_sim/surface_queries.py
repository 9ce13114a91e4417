"""Questions to a finger's surface: nearest point, side, first hit of a ray, samples on it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import warp as wp

import codesign_sim.kernels  # noqa: F401  (makes Warp quiet before its first use)
from codesign_sim.mesh import SurfaceMesh

# Metres; distances are exact within it, beyond it they are not looked for.
BAND = wp.constant(3e-3)
_PULLED_IN = 1e-3  # share of the way to a face's centroid by which its samples leave its edges

wp.set_module_options({"enable_backward": False})


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


@wp.kernel
def _cast(
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    reach: wp.float32,
    distance: wp.array[wp.float32],
    face: wp.array[wp.float32],
):
    """Distance along the ray to the first face, and that face; infinite and -1 for none."""
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, points[i], directions[i], reach)
    distance[i] = wp.INF  # type: ignore
    face[i] = -1.0  # type: ignore
    if hit.result:  # type: ignore
        distance[i] = hit.t  # type: ignore
        face[i] = wp.float32(hit.face)  # type: ignore


class SurfaceQueries:
    """A finger's surface in a tree, on the CPU, in single precision; see `queries_of`."""

    def __init__(self, mesh: SurfaceMesh) -> None:
        self._mesh = wp.Mesh(
            points=wp.array(mesh.vertices, dtype=wp.vec3, device="cpu"),
            indices=wp.array(mesh.faces.ravel(), dtype=wp.int32, device="cpu"),
            support_winding_number=True,
        )

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (M,) of points (M, 3) up to `BAND`, and the sides where those are plain.

        A side is -1 inside, 1 outside, and 0 where the nearest point does not tell.
        """
        distance, side = self._ask(_nearest, points, [], results=2)
        return distance, side

    def sides(self, points: np.ndarray) -> np.ndarray:
        """-1 inside and 1 outside (M,), by winding number."""
        return self._ask(_side, points, [], results=1)[0]

    def first_hits(
        self, points: np.ndarray, directions: np.ndarray, reach: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distance (M,) to the first face along rays of unit directions (M, 3), and its index.

        Infinite and -1 where a ray hits nothing within `reach` metres.
        """
        along: wp.array = wp.array(directions, dtype=wp.vec3, device="cpu")
        distance, face = self._ask(_cast, points, [along, float(reach)], results=2)
        return distance, face.astype(int)

    def _ask(
        self, kernel: wp.Kernel, points: np.ndarray, more: list, results: int
    ) -> list[np.ndarray]:
        found = [wp.zeros(len(points), dtype=wp.float32, device="cpu") for _ in range(results)]
        where: wp.array = wp.array(points, dtype=wp.vec3, device="cpu")
        inputs = [self._mesh.id, where, *more, *found]
        wp.launch(kernel, dim=len(points), inputs=inputs, device="cpu")
        return [array.numpy() for array in found]


@lru_cache(maxsize=4)
def queries_of(mesh: SurfaceMesh) -> SurfaceQueries:
    """The tree of a mesh; those of the last two pairs of fingers are kept."""
    return SurfaceQueries(mesh)


def spread_samples(mesh: SurfaceMesh, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """About one point per spacing^2 of surface: points (M, 3) and the face (M,) of each."""
    areas = np.linalg.norm(mesh.normals_by_area, axis=1)
    filled = np.cumsum(areas)
    count = int(np.ceil(filled[-1] / spacing**2))
    face = np.searchsorted(filled, (np.arange(count) + 0.5) * filled[-1] / count)
    # Barycentric coordinates from a low-discrepancy sequence, folded into the triangle.
    uv = np.modf((np.arange(count)[:, None] + 0.5) * [0.7548776662466927, 0.5698402909980532])[0]
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv)
    weights = np.column_stack([1 - uv.sum(axis=1), uv])
    return np.einsum("pc,pck->pk", weights, mesh.vertices[mesh.faces[face]]), face


def edge_samples(mesh: SurfaceMesh, faces: np.ndarray, step: float) -> np.ndarray:
    """Points (M, 3) on the edges of some faces, ends included, at most `step` metres apart.

    They are pulled into a face by a thousandth of it, so that no ray from them runs along the
    wall beside it.
    """
    start = mesh.faces[faces]
    end = np.roll(start, -1, axis=1)
    either = np.minimum(start, end) * len(mesh.vertices) + np.maximum(start, end)
    _, first = np.unique(either, return_index=True)
    ends = np.stack([mesh.vertices[side.ravel()[first]] for side in (start, end)], axis=1)
    centre = mesh.vertices[start].mean(axis=1)[first // 3]
    ends += _PULLED_IN * (centre[:, None] - ends)
    counts = np.ceil(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / step).astype(int)
    edge = np.repeat(np.arange(len(counts)), counts + 1)
    number = np.arange(len(edge)) - np.repeat(np.cumsum(counts + 1) - counts - 1, counts + 1)
    share = (number / counts[edge])[:, None]
    return ends[edge, 0] + share * (ends[edge, 1] - ends[edge, 0])
