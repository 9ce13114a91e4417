"""What is right and wrong with a triangle surface, as a solid to print or to simulate."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from codesign_design.finger_pair import TriangleMesh
from codesign_design.self_intersection import intersects_itself, self_intersecting_faces


@dataclass(frozen=True)
class MeshChecks:
    """Measures of one surface.

    Attributes:
        vertices, faces: counts.
        watertight: every edge borders exactly two faces.
        winding_consistent: those two run along it in opposite directions, and the volume is
            positive.
        self_intersecting_faces: number of faces that cut through another one.
        components: connected pieces.
        genus: number of through-holes, summed over the pieces; meaningless unless watertight.
        volume: enclosed [m^3].
        centre_of_mass: of the enclosed volume, evenly filled [m].
    """

    vertices: int
    faces: int
    watertight: bool
    winding_consistent: bool
    self_intersecting_faces: int
    components: int
    genus: int
    volume: float
    centre_of_mass: tuple[float, float, float]

    @property
    def valid(self) -> bool:
        """Watertight, wound outward, free of self-intersections, and in one piece."""
        return not self.problems

    @property
    def problems(self) -> list[str]:
        """What keeps the surface from being valid, each with its value and limit."""
        found = []
        if not self.watertight:
            found.append("not watertight: some edges do not border exactly 2 faces")
        if not self.winding_consistent:
            found.append(f"wound inconsistently or inward (volume {self.volume * 1e9:.1f} mm^3)")
        if self.self_intersecting_faces:
            found.append(f"{self.self_intersecting_faces} faces intersect others, 0 are allowed")
        if self.components != 1:
            found.append(f"{self.components} separate pieces, expected 1")
        return found


def check_mesh(surface: TriangleMesh) -> MeshChecks:
    """Measures a surface; it may be broken in any way but its vertices must be finite."""
    faces = surface.faces
    watertight, consistent = edge_checks(faces)
    components = face_components(faces)[1]
    volume, centre = volume_and_centre(surface)
    used = len(np.unique(faces))
    genus = components - (used - len(faces) * 3 // 2 + len(faces)) // 2
    return MeshChecks(
        vertices=used,
        faces=len(faces),
        watertight=watertight,
        winding_consistent=consistent and volume > 0,
        self_intersecting_faces=len(self_intersecting_faces(surface)),
        components=components,
        genus=genus,
        volume=volume,
        centre_of_mass=(float(centre[0]), float(centre[1]), float(centre[2])),
    )


def is_valid(surface: TriangleMesh) -> bool:
    """`check_mesh(surface).valid`, with a quicker no."""
    return (
        all(edge_checks(surface.faces))
        and volume_and_centre(surface)[0] > 0
        and face_components(surface.faces)[1] == 1
        and not intersects_itself(surface)
    )


def check_closed(surface: TriangleMesh, name: str) -> None:
    """Whether every edge borders exactly two faces.

    Raises:
        ValueError: it does not; says how many edges are open and how many belong to more faces.
    """
    faces_at_edge = _edges(surface.faces)
    if not len(faces_at_edge) or (faces_at_edge != 2).any():
        raise ValueError(
            f"{name} is not closed: of {len(faces_at_edge)} edges {(faces_at_edge == 1).sum()} are "
            f"open and {(faces_at_edge > 2).sum()} belong to more than two faces, 0 are allowed; "
            "fill its holes and remove inner faces in a mesh editor (Blender: 3D Print Toolbox, "
            "Make Manifold)"
        )


def edge_checks(faces: NDArray[np.int32]) -> tuple[bool, bool]:
    """Whether every edge borders exactly two faces, and whether those are wound consistently."""
    start, end = _ends(faces)
    watertight = len(faces) > 0 and bool((_edges(faces) == 2).all() and (start != end).all())
    directed = np.unique(start * (int(faces.max(initial=0)) + 1) + end, return_counts=True)[1]
    return watertight, bool((directed == 1).all())


def _edges(faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Number of faces at each edge."""
    start, end = _ends(faces)
    size = int(faces.max(initial=0)) + 1
    return np.unique(np.minimum(start, end) * size + np.maximum(start, end), return_counts=True)[1]


def _ends(faces: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and second vertex of each face's edges, 3F of them."""
    return faces.astype(np.int64).ravel(), np.roll(faces, -1, axis=1).astype(np.int64).ravel()


def face_components(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], int]:
    """Label of each face's connected piece (F,), and the number of pieces."""
    if not len(faces):
        return np.zeros(0, dtype=np.int32), 0
    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(faces.shape)
    ones = np.ones(2 * len(faces), dtype=np.int8)
    rows, columns = local[:, [0, 0]].ravel(), local[:, [1, 2]].ravel()
    count, of_vertex = connected_components(
        coo_matrix((ones, (rows, columns)), shape=(len(used), len(used))), directed=False
    )
    return of_vertex[local[:, 0]], int(count)


def volume_and_centre(surface: TriangleMesh) -> tuple[float, NDArray[np.float64]]:
    """Enclosed volume [m^3] and its centroid [m]: the sum over tetrahedra from a common point."""
    origin = surface.vertices.mean(axis=0)
    a, b, c = (surface.vertices[surface.faces] - origin).transpose(1, 0, 2)
    sixth = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    volume = float(sixth.sum())
    if abs(volume) < 1e-300:
        return 0.0, origin
    return volume, origin + np.einsum("i,ij->j", sixth, a + b + c) / (4.0 * volume)
