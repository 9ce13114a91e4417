"""Triangles of a surface that cut through each other.

Broad phase: a hierarchy of bounding boxes tested against itself, level by level. Narrow phase: an
edge of one triangle passes through the other, or two coplanar triangles overlap. Neighbours that
merely share a vertex or an edge, and triangles that touch, do not count.
"""

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import TriangleMesh

_LEAF = 4  # triangles per leaf box
_TOUCHING = 1e-8  # of the bounding box's diagonal: a depth below this is a touch
_FIRST = 4096  # pairs that are tried before all others, to be done early


def self_intersecting_faces(surface: TriangleMesh) -> NDArray[np.int64]:
    """Sorted indices of the faces that intersect another face.

    Exact but for rounding: penetrations of less than 1e-8 of the surface's size are not seen.
    """
    if not len(surface.faces):
        return np.zeros(0, dtype=np.int64)
    corners = surface.vertices[surface.faces]
    first, second = _overlapping_boxes(corners)
    hit = _intersect(corners, first, second, _touch(surface))
    return np.unique(np.concatenate([first[hit], second[hit]]))


def intersects_itself(surface: TriangleMesh) -> bool:
    """Whether there are any `self_intersecting_faces`; faster where there are many."""
    if not len(surface.faces):
        return False
    corners = surface.vertices[surface.faces]
    first, second = _overlapping_boxes(corners)
    return any(
        _intersect(corners, first[part], second[part], _touch(surface)).any()
        for part in (slice(_FIRST), slice(_FIRST, None))
    )


def _touch(surface: TriangleMesh) -> float:
    """Depth below which triangles touch [m]."""
    return _TOUCHING * float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))


def _overlapping_boxes(
    corners: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of triangles, each once, whose bounding boxes overlap."""
    order = _along_a_curve(corners.mean(axis=1))
    count = len(order)
    levels = max(0, int(np.ceil(np.log2(max(1, count / _LEAF)))))
    low = np.full((3, _LEAF * 2**levels), np.inf)
    high = np.full_like(low, -np.inf)
    low[:, :count], high[:, :count] = corners.min(axis=1)[order].T, corners.max(axis=1)[order].T
    sizes = [_LEAF] + [2] * levels
    lows, highs = [low], [high]
    for size in sizes:
        lows.append(lows[-1].reshape(3, -1, size).min(axis=2))
        highs.append(highs[-1].reshape(3, -1, size).max(axis=2))
    i = j = np.zeros(1, dtype=np.int32)
    for size, low, high in zip(sizes[::-1], lows[-2::-1], highs[-2::-1], strict=True):
        a, b = np.divmod(np.arange(size * size, dtype=np.int32), np.int32(size))
        i, j = (i[:, None] * size + a).ravel(), (j[:, None] * size + b).ravel()
        keep = i < j if low is lows[0] else i <= j
        i, j = i[keep], j[keep]
        for axis in range(3):
            keep = (low[axis][i] <= high[axis][j]) & (low[axis][j] <= high[axis][i])
            i, j = i[keep], j[keep]
    return order[i], order[j]


def _along_a_curve(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Order of points along a Morton curve, so that neighbours in space are near in the order."""
    low = points.min(axis=0)
    cells = ((points - low) / max(np.ptp(points, axis=0).max(), 1e-300) * 1023).astype(np.int64)
    code = np.zeros(len(points), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")


def _intersect(
    corners: NDArray[np.float64], first: NDArray[np.int64], second: NDArray[np.int64], touch: float
) -> NDArray[np.bool_]:
    """Whether each pair of triangles intersects."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.maximum(length, 1e-300)
    offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
    hit = np.zeros(len(first), dtype=bool)
    near = np.arange(len(first))
    heights: list[NDArray[np.float64]] = []
    for a, b in ((first, second), (second, first)):
        height = _heights(corners, normals, offsets, a[near], b[near], touch)
        # Wholly on one side, neighbours with their common corners in the plane included.
        beside = ((height >= 0).all(axis=0) | (height <= 0).all(axis=0)) & height.any(axis=0)
        near = near[~beside]
        heights = [h[:, ~beside] for h in [*heights, height]]
    flat = ~heights[0].any(axis=0) | ~heights[1].any(axis=0)
    for a, b, height in ((first, second, heights[0]), (second, first, heights[1])):
        hit[near] |= _edge_passes(corners[a[near]], corners[b[near]], height) & ~flat
    flat_pairs = near[flat]
    hit[flat_pairs] = _coplanar_overlap(
        corners[first[flat_pairs]], corners[second[flat_pairs]], normals[first[flat_pairs]], touch
    )
    return hit


def _heights(
    corners: NDArray[np.float64],
    normals: NDArray[np.float64],
    offsets: NDArray[np.float64],
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    touch: float,
) -> NDArray[np.float64]:
    """Heights (3, K) of b's corners above a's plane; 0 where they touch it."""
    height = np.einsum("kij,kj->ik", corners[b], normals[a], order="C") - offsets[a]
    return np.where(np.abs(height) <= touch, 0.0, height)


def _edge_passes(
    a: NDArray[np.float64], b: NDArray[np.float64], height: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether an edge of b, its corners `height` above a's plane, passes through a; (K, 3, 3)."""
    hit = np.zeros(len(a), dtype=bool)
    for k in range(3):
        start, end = b[:, k], b[:, (k + 1) % 3]
        crosses = np.flatnonzero(height[k] * height[(k + 1) % 3] < 0)
        origin = a[crosses] - start[crosses, None]
        along = end[crosses] - start[crosses]
        sides = [
            np.einsum("ij,ij->i", along, np.cross(origin[:, m], origin[:, (m + 1) % 3]))
            for m in range(3)
        ]
        side = np.stack(sides)
        hit[crosses] |= (side >= 0).all(axis=0) | (side <= 0).all(axis=0)
    return hit


def _coplanar_overlap(
    a: NDArray[np.float64], b: NDArray[np.float64], normals: NDArray[np.float64], touch: float
) -> NDArray[np.bool_]:
    """Whether triangles in one plane overlap: no edge of either separates them."""
    left = np.arange(len(a))  # not separated so far; neighbours soon are
    for edges_of_a in (True, False):
        for k in range(3):
            one, other = a[left], b[left]
            corners = one if edges_of_a else other
            across = np.cross(corners[:, (k + 1) % 3] - corners[:, k], normals[left])
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
            on_a, on_b = (np.einsum("kij,kj->ik", t, across, order="C") for t in (one, other))
            apart = (on_a.max(axis=0) <= on_b.min(axis=0) + touch) | (
                on_b.max(axis=0) <= on_a.min(axis=0) + touch
            )
            left = left[~apart]
    overlap = np.zeros(len(a), dtype=bool)
    overlap[left] = True
    return overlap
