"""How far a pair of fingers can close before they would run into each other."""

from __future__ import annotations

import hashlib
from functools import lru_cache

import numpy as np

from codesign_sim import disk_cache
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.surface_queries import edge_samples, queries_of

STEP = 0.5e-3  # metres between the points of one finger that are looked at
_EXACT = 1e-6  # metres; no search for a limit larger by less than this
_AT_ONCE = 4096  # rays
_VERSION = 1  # of what is computed here; raise it whenever equal meshes would give another result


def closing_limit(left: SurfaceMesh, right: SurfaceMesh) -> float:
    """The gap at which two rigid fingers first touch when they close, in metres; at least 0.

    Fingers move along y alone, so it is the largest overlap along any line in that direction of
    the fingers at gap 0. The first touch is that of a corner with a face or of two edges, so
    points on either finger's edges, at most 0.5 mm apart, are compared with the other finger's
    surface along such lines. The limit is exact to 2 um plus a thousandth of the triangles' slope
    where a corner meets a face or two flat faces meet; where sloping edges cross it may be too
    small by 0.25 mm times their slope against the closing plane, and an overlap narrower than
    0.5 mm sideways may be missed. Known pairs come from the user's cache.

    Args:
        left, right: surfaces in the grasp frame at gap 0 (see `FingerTargets`).
    """
    return _limit_cached(_Pair(left, right))


class _Pair:
    """Two meshes that compare by their content."""

    def __init__(self, left: SurfaceMesh, right: SurfaceMesh) -> None:
        self.left, self.right = left, right
        content = f"closing {left.content_hash} {right.content_hash} {_VERSION} {STEP}"
        self.key = hashlib.sha256(content.encode()).hexdigest()

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Pair) and self.key == other.key


@lru_cache(maxsize=256)
def _limit_cached(pair: _Pair) -> float:
    kept = disk_cache.load(pair.key, ("limit",))
    if kept is not None:
        return float(kept["limit"])
    limit = _largest_overlap(pair.left, pair.right)
    disk_cache.store(pair.key, {"limit": np.array(limit)})
    return limit


def _largest_overlap(left: SurfaceMesh, right: SurfaceMesh) -> float:
    low, high = _shared_window(left, right)
    if (low >= high).any() or left.vertices[:, 1].min() >= right.vertices[:, 1].max():
        return 0.0
    limit = 0.0
    for mesh, other, way in ((left, right, -1.0), (right, left, 1.0)):
        ahead = (way * mesh.vertices[mesh.faces, 1]).max(axis=1)
        overlapping = ahead > (way * other.vertices[:, 1]).min() + limit + _EXACT
        towards_other = way * mesh.normals_by_area[:, 1] > 0
        points = edge_samples(mesh, np.flatnonzero(overlapping & towards_other), STEP)
        within = (points[:, [0, 2]] > low) & (points[:, [0, 2]] < high)
        limit = _search(points[within.all(axis=1)], other, way, limit)
    return limit


def _shared_window(left: SurfaceMesh, right: SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (2,) in x, z of where the fingers can meet."""
    bounds = [mesh.vertices[:, [0, 2]] for mesh in (left, right)]
    low = np.maximum(*(b.min(axis=0) for b in bounds))
    return low, np.minimum(*(b.max(axis=0) for b in bounds))


def _search(points: np.ndarray, other: SurfaceMesh, way: float, limit: float) -> float:
    """The larger of `limit` and the overlaps of points of one finger with the other finger.

    The points that could overlap most come first, so that most are never looked at.

    Args:
        way: from the points' finger to the other, along y.
    """
    front = float((-way * other.vertices[:, 1]).max())  # of the other finger, towards the points
    could = front + way * points[:, 1]
    hopeful = np.flatnonzero(could > limit + _EXACT)
    hopeful = hopeful[np.argsort(-could[hopeful])]
    outside = front + 1e-3  # where rays start, so that they meet the front of the other finger
    for first in range(0, len(hopeful), _AT_ONCE):
        chosen = hopeful[first : first + _AT_ONCE]
        if could[chosen[0]] <= limit + _EXACT:
            break
        start = points[chosen]
        start[:, 1] = -way * outside
        towards = np.tile([0.0, way, 0.0], (len(chosen), 1))
        distance, _ = queries_of(other).first_hits(start, towards, could[chosen[0]] + 2e-3)
        overlap = float((way * points[chosen, 1] + outside - distance).max())
        limit = overlap if overlap > limit + _EXACT else limit
    return limit
