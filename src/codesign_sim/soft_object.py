"""A soft object as tetrahedra, and what the time step needs of its shape."""

from __future__ import annotations

from functools import cached_property

import numpy as np


class SoftObject:
    """Base of `Block` and `TetrahedralMesh`; the simulator knows no more than this.

    Attributes:
        nodes: (N, 3) rest positions in the object frame, whose origin is the centre of mass, m.
        tetrahedra: (T, 4) node indices, positively oriented.
        size: lengths of the smallest box around it along x, y, z, m.
    """

    nodes: np.ndarray
    tetrahedra: np.ndarray
    size: tuple[float, float, float]

    @property
    def resolution(self) -> int:
        """Number of tetrahedra."""
        return len(self.tetrahedra)

    @property
    def base_height(self) -> float:
        """Of the centre of mass above the lowest node, m."""
        return -float(self.nodes[:, 2].min())

    @property
    def volume(self) -> float:
        """Rest volume in m^3."""
        return float(self.volumes.sum())

    @property
    def cell_size(self) -> float:
        """Edge of the cube whose tetrahedra are as thin as the thinnest here, m."""
        faces = self.nodes[tetrahedron_faces(self.tetrahedra)]
        area = np.linalg.norm(_crossed(faces), axis=1).reshape(-1, 4).max(axis=1) / 2
        return float(np.sqrt(3) * (3 * self.volumes / area).min())

    @cached_property
    def volumes(self) -> np.ndarray:
        """Rest volume (T,) of every tetrahedron, m^3."""
        return tetrahedron_volumes(self.nodes, self.tetrahedra)

    @cached_property
    def inverse_edges(self) -> np.ndarray:
        """Inverse rest edge matrices (T, 3, 3), 1/m: F = [x1-x0, x2-x0, x3-x0] @ this."""
        x = self.nodes[self.tetrahedra]
        return np.linalg.inv(np.transpose(x[:, 1:] - x[:, :1], (0, 2, 1)))

    @cached_property
    def load_volumes(self) -> np.ndarray:
        """Volume (N,) whose weight acts on every node, m^3.

        A quarter of each tetrahedron around it: the load that linear elements carry without
        spurious stress.
        """
        share = np.repeat(self.volumes / 4, 4)
        return np.bincount(self.tetrahedra.ravel(), share, minlength=len(self.nodes))

    @property
    def node_volumes(self) -> np.ndarray:
        """Volume (N,) whose inertia every node carries, m^3."""
        return self.load_volumes

    @cached_property
    def _surface(self) -> tuple[np.ndarray, np.ndarray]:
        # The boundary is what occurs once.
        faces = tetrahedron_faces(self.tetrahedra)
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        boundary = np.sort(first[count == 1])
        # Side by side: triangles close in space share vectors and are near fingers together.
        normal = _crossed(self.nodes[faces[boundary]])
        side = np.argmax(np.abs(normal), axis=1) * 2 + (normal.sum(axis=1) > 0)
        order = np.argsort(side, kind="stable")
        boundary = boundary[order]
        return faces[boundary], boundary // 4

    @property
    def surface_triangles(self) -> np.ndarray:
        """Node indices (S, 3) of the boundary, wound outwards."""
        return self._surface[0]

    @property
    def surface_tetrahedra(self) -> np.ndarray:
        """Tetrahedron (S,) behind each boundary triangle."""
        return self._surface[1]

    @cached_property
    def surface_areas(self) -> np.ndarray:
        """Rest area (S,) of every boundary triangle, m^2."""
        return np.linalg.norm(_crossed(self.nodes[self.surface_triangles]), axis=1) / 2


def tetrahedron_volumes(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Signed volumes (T,), negative where inverted, in the nodes' unit cubed."""
    a, b, c, d = (nodes[tetrahedra[:, k]] for k in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6


def tetrahedron_faces(tetrahedra: np.ndarray) -> np.ndarray:
    """Faces (4 T, 3) opposite each corner, wound outwards."""
    return tetrahedra[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)


def _crossed(corners: np.ndarray) -> np.ndarray:
    """Twice the area vectors (M, 3) of triangles (M, 3, 3)."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
