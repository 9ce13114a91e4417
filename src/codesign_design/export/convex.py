"""Convex pieces of a finger, for simulators that collide convex shapes only.

The piece whose hull adds most volume is cut in two, again and again, at the middle of the axis
where that helps most. CoACD finds better cuts, but on these meshes it took half a minute or hung.
"""

from dataclasses import dataclass

from manifold3d import Manifold

from codesign_design.finger_pair import TriangleMesh
from codesign_design.solid import to_solid, to_surface

ADDED = 0.03  # of the finger's volume, that all hulls together may add
MOST_PIECES = 24


def convex_pieces(mesh: TriangleMesh) -> list[TriangleMesh]:
    """Convex surfaces that together cover the finger, and little else."""
    solid = to_solid(mesh)
    pieces = [_Piece.of(solid)]
    while len(pieces) < MOST_PIECES and _added(pieces) > ADDED * solid.volume():
        worst = max(pieces, key=lambda piece: piece.added)
        pieces.remove(worst)
        pieces += _best_cut(worst.solid)
    return [to_surface(piece.hull) for piece in pieces]


@dataclass(frozen=True, eq=False)
class _Piece:
    """A piece, its hull, and what the hull adds [mm^3]."""

    solid: Manifold
    hull: Manifold
    added: float

    @staticmethod
    def of(solid: Manifold) -> "_Piece":
        hull = solid.hull()
        return _Piece(solid, hull, hull.volume() - solid.volume())


def _added(pieces: list[_Piece]) -> float:
    return sum(piece.added for piece in pieces)


def _best_cut(solid: Manifold) -> list[_Piece]:
    box = solid.bounding_box()
    cuts = []
    for axis in range(3):
        normal = tuple(float(axis == k) for k in range(3))
        halves = solid.split_by_plane(normal, (box[axis] + box[axis + 3]) / 2.0)
        cuts.append([_Piece.of(part) for part in halves if not part.is_empty()])
    return min(cuts, key=_added)
