"""Convex pieces of a finger, for simulators that collide convex shapes only.

The piece whose hull adds most volume is cut in two, again and again, at the middle of the axis
where that helps most. CoACD finds better cuts, but on these meshes it took half a minute or hung.
"""

from manifold3d import Manifold

from codesign_design.finger_pair import TriangleMesh
from codesign_design.solid import to_solid, to_surface

ADDED = 0.03  # of the finger's volume, that all hulls together may add
MOST_PIECES = 24


def convex_pieces(mesh: TriangleMesh) -> list[TriangleMesh]:
    """Convex surfaces that together cover the finger, and little else."""
    solid = to_solid(mesh)
    pieces = [solid]
    while len(pieces) < MOST_PIECES and sum(map(_added, pieces)) > ADDED * solid.volume():
        worst = max(pieces, key=_added)
        pieces.remove(worst)
        pieces += _best_cut(worst)
    return [to_surface(piece.hull()) for piece in pieces]


def _added(piece: Manifold) -> float:
    """What the hull adds to a piece [mm^3]."""
    return piece.hull().volume() - piece.volume()


def _best_cut(piece: Manifold) -> list[Manifold]:
    box = piece.bounding_box()
    cuts = []
    for axis in range(3):
        normal = tuple(float(axis == k) for k in range(3))
        halves = piece.split_by_plane(normal, (box[axis] + box[axis + 3]) / 2.0)
        cuts.append([part for part in halves if not part.is_empty()])
    return min(cuts, key=lambda parts: sum(map(_added, parts)))
