"""What a user wants to know of a tetrahedral mesh before simulating it."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from codesign_sim.material import Material, stable_time_step
from codesign_sim.simulator import CONTACT_STIFFNESS, SAFETY, STIFFNESS_DAMPING
from codesign_sim.tet_mesh import TetrahedralMesh


@dataclass(frozen=True)
class ObjectReport:
    """Figures of a sound mesh, in SI units.

    Attributes:
        tetrahedra, nodes, surface_triangles: counts.
        size: lengths of the smallest box around it, m.
        volume: m^3.
        mass: at the material's density, kg.
        worst_quality: smallest mean ratio of a tetrahedron; 1 is regular.
        volume_ratio: largest over smallest tetrahedron; the top-10 % stress counts tetrahedra,
            so it weighs finely meshed places more.
        contact_spacing: largest distance between neighbouring contact points, m; what is
            narrower can slip between them.
        time_step: the simulator's own choice, s.
    """

    tetrahedra: int
    nodes: int
    surface_triangles: int
    size: tuple[float, float, float]
    volume: float
    mass: float
    worst_quality: float
    volume_ratio: float
    contact_spacing: float
    time_step: float

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


def report_on(mesh: TetrahedralMesh, material: Material) -> ObjectReport:
    """The figures of a mesh made of a material."""
    corners = mesh.nodes[mesh.surface_triangles]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    limit = stable_time_step(mesh, material, CONTACT_STIFFNESS, STIFFNESS_DAMPING)
    return ObjectReport(
        tetrahedra=mesh.resolution,
        nodes=len(mesh.nodes),
        surface_triangles=len(mesh.surface_triangles),
        size=mesh.size,
        volume=mesh.volume,
        mass=mesh.volume * material.density,
        worst_quality=mesh.worst_quality,
        volume_ratio=float(mesh.volumes.max() / mesh.volumes.min()),
        contact_spacing=float(edges.max()) / 2,  # the points lie half an edge apart
        time_step=SAFETY * limit,
    )
