"""A finger pair as the simulator's surfaces.

Fingers with a lip get a sole. The lip slides on the table, so nothing can be below it; but the
simulated table holds the block only, and a contact point of the block's base, a few hundredths of
a millimetre in the table, would find itself under the lip for good. The sole fills what is below
the lip, rounded undersides too: what the lip reaches is then above it. The real finger has none.
"""

import numpy as np
from manifold3d import CrossSection, Manifold, OpType

from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_design.solid import MM, to_solid, to_surface
from codesign_policy.finger_plan import LEAST_LIP, front_view
from codesign_sim import SurfaceMesh

SOLE = 0.0025  # m, thicker than contact points ever sink into a surface
_CUTS = np.arange(0.05, 1.5, 0.2)  # mm above the tips, where the foot's outline is taken
_NEW_AREA = 1.0  # mm^2, an outline that adds less is left out
_CLEANED = 1e-3  # mm, to which slivers of the union are removed


def simulated_fingers(fingers: FingerPair) -> tuple[SurfaceMesh, SurfaceMesh]:
    """Left and right surface for `codesign_sim.Simulator`, in the grasp frame at gap 0.

    Raises:
        ValueError: a mesh is not a closed surface, wound outward.
    """
    if lip(fingers) <= LEAST_LIP:
        left, right = (SurfaceMesh(m.vertices, m.faces) for m in (fingers.left, fingers.right))
        return left, right
    return with_sole(fingers.left), with_sole(fingers.right)


def lip(fingers: FingerPair) -> float:
    """How far the foot of a finger protrudes beyond its pad [m]; inf where there is no pad."""
    return front_view(fingers.left).lip


def with_sole(mesh: TriangleMesh) -> SurfaceMesh:
    """The finger, filled below its foot and thicker there by `SOLE`.

    Raises:
        ValueError: the mesh encloses no solid.
    """
    solid = to_solid(mesh)
    united = Manifold.batch_boolean([solid, *_fillings(solid)], OpType.Add)
    surface = to_surface(united.simplify(_CLEANED))
    return SurfaceMesh(surface.vertices, surface.faces)


def _fillings(solid: Manifold) -> list[Manifold]:
    """What is below the foot [mm]: outlines at several heights, each down to the sole's end."""
    tip, covered, found = solid.bounding_box()[5], CrossSection(), []
    for cut in _CUTS:
        outline = solid.slice(tip - cut)
        if (outline - covered).area() > _NEW_AREA:
            found.append(outline.extrude(SOLE * MM + cut).translate((0.0, 0.0, tip - cut)))
            covered += outline
    return found
