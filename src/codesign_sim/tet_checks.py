"""Checks of a user's tetrahedral mesh: an error names the first offending indices."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from codesign_sim.soft_object import tetrahedron_faces, tetrahedron_volumes

LEAST_QUALITY = 0.05  # below it a tetrahedron counts as degenerate; a regular one has 1
SMALLEST, LARGEST = 2e-3, 1.0  # m, of the longest side of a mesh that can be in metres
_SAME_PLACE = 1e-6  # of the longest side; nodes nearer than this are duplicates


def quality(nodes: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Mean ratio (T,) 12 (3 V)^(2/3) / sum of squared edges: 1 for regular, 0 for flat.

    Negative where inverted (Liu and Joe 1994, "Relationship between tetrahedron shape measures").
    """
    volume = tetrahedron_volumes(nodes, tetrahedra)
    first, second = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]).T
    edges = nodes[tetrahedra[:, first]] - nodes[tetrahedra[:, second]]
    squares = (edges**2).sum(axis=(1, 2))
    return np.sign(volume) * 12 * (3 * np.abs(volume)) ** (2 / 3) / np.maximum(squares, 1e-300)


def require_sound(nodes: np.ndarray, tetrahedra: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (N, 3) in metres and tetrahedra (T, 4), as arrays, if they make up one soft object.

    Not looked for: tetrahedra that overlap without sharing faces.

    Raises:
        ValueError: wrong shapes, numbers that are not finite, indices out of range, a size that
            cannot be in metres, unreferenced or duplicate nodes, degenerate or inverted
            tetrahedra, several pieces, a surface that is not a manifold.
    """
    nodes = np.asarray(nodes, dtype=np.float64)
    if nodes.ndim != 2 or nodes.shape[1] != 3:
        raise ValueError(f"mesh nodes have shape {nodes.shape}; they must be (N, 3)")
    tetrahedra = np.asarray(tetrahedra)
    if tetrahedra.ndim != 2 or tetrahedra.shape[1] != 4 or tetrahedra.dtype.kind not in "iu":
        raise ValueError(
            f"mesh tetrahedra are {tetrahedra.dtype} of shape {tetrahedra.shape}; they must be "
            "integers of shape (T, 4)"
        )
    if len(tetrahedra) == 0:
        raise ValueError("mesh has no tetrahedra")
    tetrahedra = tetrahedra.astype(np.int64)
    _refuse("nodes are not finite", ~np.isfinite(nodes).all(axis=1), "repair the file")
    beyond = ((tetrahedra < 0) | (tetrahedra >= len(nodes))).any(axis=1)
    _refuse(f"tetrahedra name nodes beyond the {len(nodes)} there are", beyond, "repair the file")
    _check_scale(nodes)
    _check_nodes(nodes, tetrahedra)
    _check_shapes(nodes, tetrahedra)
    _check_connections(tetrahedra)
    return nodes, tetrahedra


def _refuse(what: str, wrong: Any, remedy: str) -> None:
    """Raises if any of `wrong` (M,) is set, with the first ten indices."""
    index = np.flatnonzero(wrong)
    if len(index):
        some = ", ".join(str(i) for i in index[:10]) + (", ..." if len(index) > 10 else "")
        raise ValueError(f"{len(index)} {what} (index {some}); {remedy}")


def _check_scale(nodes: np.ndarray) -> None:
    size = np.ptp(nodes, axis=0)
    if SMALLEST <= size.max() <= LARGEST:
        return
    hint = "if it is in millimetres, load it with scale 0.001"
    if size.max() < SMALLEST:
        hint = "if it was scaled twice, or is in kilometres, load it with scale 1000"
    raise ValueError(
        f"mesh measures {size[0]:.4g} x {size[1]:.4g} x {size[2]:.4g} m; its longest side must be "
        f"between {SMALLEST:g} and {LARGEST:g} m: coordinates are metres, {hint}"
    )


def _check_nodes(nodes: np.ndarray, tetrahedra: np.ndarray) -> None:
    used = np.zeros(len(nodes), dtype=bool)
    used[tetrahedra] = True
    _refuse("nodes belong to no tetrahedron", ~used, "remove them from the file")
    near = _SAME_PLACE * np.ptp(nodes, axis=0).max()
    duplicate = np.zeros(len(nodes), dtype=bool)
    duplicate[cKDTree(nodes).query_pairs(near, output_type="ndarray")] = True
    _refuse("nodes lie on another node", duplicate, "merge them, or the mesh falls apart there")


def _check_shapes(nodes: np.ndarray, tetrahedra: np.ndarray) -> None:
    shape = quality(nodes, tetrahedra)
    flat = np.abs(shape) < LEAST_QUALITY
    worst = f"the worst is {np.abs(shape).min():.2g}"
    what = f"tetrahedra are degenerate, of quality below {LEAST_QUALITY:g}: {worst}"
    _refuse(what, flat, "mesh again with better elements")
    _refuse("tetrahedra are inverted", shape < 0, "swap two corners of each")


def _check_connections(tetrahedra: np.ndarray) -> None:
    faces = tetrahedron_faces(tetrahedra)
    _, face, uses = np.unique(
        np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    face = face.ravel()
    crowded = (uses[face] > 2).reshape(-1, 4).any(axis=1)
    _refuse("tetrahedra share a face with two others", crowded, "remove overlapping ones")
    owner = np.arange(len(faces)) // 4
    table = sparse.csr_matrix((np.ones(len(faces)), (owner, face)))
    count, piece = connected_components(table @ table.T, directed=False)
    if count > 1:
        sizes = np.bincount(piece)
        first = ", ".join(str(np.flatnonzero(piece == k)[0]) for k in range(min(count, 10)))
        raise ValueError(
            f"mesh falls into {count} pieces that share no face, the largest of {sizes.max()} "
            f"tetrahedra (first of each: index {first}); give one connected object"
        )
    boundary = faces[uses[face] == 1]
    edges = np.sort(boundary[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, edge_uses = np.unique(edges, axis=0, return_counts=True)
    pinched = np.zeros(int(tetrahedra.max()) + 1, dtype=bool)
    pinched[edges[edge_uses != 2]] = True
    _refuse(
        "nodes lie on surface edges with more than two triangles, so the surface is no manifold",
        pinched,
        "join the parts by faces or separate them",
    )
