"""A finger pair as the simulator's surfaces.

Fingers with a lip get a sole. The lip slides on the table, so nothing can be below it; but the
simulated table holds the block only, and a contact point of the block's base, a few hundredths of
a millimetre in the table, would find itself under the lip for good. The sole goes on where the lip
ends: what the lip reaches is then above it. The real finger has none, and needs none.
"""

import numpy as np
from manifold3d import Manifold, Mesh64

from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_policy.finger_plan import LEAST_LIP, front_view
from codesign_sim import SurfaceMesh

SOLE = 0.0025  # m, thicker than contact points ever sink into a surface
_CUT = 0.00005  # m above the tips, where the lip's outline is taken


def simulated_fingers(fingers: FingerPair) -> tuple[SurfaceMesh, SurfaceMesh]:
    """Left and right surface for `codesign_sim.Simulator`, in the grasp frame at gap 0.

    Raises:
        ValueError: a mesh is not a closed surface, wound outward.
    """
    left, right = (SurfaceMesh(m.vertices, m.faces) for m in (fingers.left, fingers.right))
    if front_view(fingers.left).lip <= LEAST_LIP:
        return left, right
    return with_sole(fingers.left), with_sole(fingers.right)


def with_sole(mesh: TriangleMesh) -> SurfaceMesh:
    """The finger, thicker by `SOLE` below its lowest face.

    Raises:
        ValueError: the mesh encloses no solid.
    """
    solid = Manifold(Mesh64(mesh.vertices * 1e3, mesh.faces.astype(np.uint64)))
    if solid.is_empty():
        raise ValueError(f"finger mesh encloses no solid: {solid.status()}; repair it first")
    cut = mesh.vertices[:, 2].max() - _CUT
    sole = solid.slice(cut * 1e3).extrude((SOLE + _CUT) * 1e3)
    united = (solid + sole.translate((0.0, 0.0, cut * 1e3))).to_mesh64()
    vertices = np.asarray(united.vert_properties[:, :3], dtype=np.float64) / 1e3
    return SurfaceMesh(vertices, np.asarray(united.tri_verts, dtype=np.int32))
