"""Tetrahedral meshes of other shapes than a box, for the tests."""

import numpy as np

from codesign_sim import Block, TetrahedralMesh


def to_disc(xy):
    """Maps the square |x|, |y| <= 1 to the unit disc (elliptical grid mapping)."""
    x, y = xy.T
    return np.column_stack([x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)])


def cylinder(radius=0.02, height=0.03, across=6, along=6):
    """Upright."""
    box = Block((2.0, 2.0, height), (across, across, along))
    disc = radius * to_disc(box.nodes[:, :2])
    return TetrahedralMesh(np.column_stack([disc, box.nodes[:, 2]]), box.tetrahedra)


def ball(radius=0.02, across=8):
    box = Block((2.0, 2.0, 2.0), (across,) * 3)
    x, y, z = box.nodes.T
    squares = x**2, y**2, z**2
    nodes = [
        a * np.sqrt(1 - squares[j] / 2 - squares[k] / 2 + squares[j] * squares[k] / 3)
        for a, j, k in ((x, 1, 2), (y, 2, 0), (z, 0, 1))
    ]
    return TetrahedralMesh(radius * np.column_stack(nodes), box.tetrahedra)


def l_shape(size=0.03, cells=6):
    """A cube without the upper half of one side."""
    box = Block((size,) * 3, (cells,) * 3)
    centre = box.nodes[box.tetrahedra].mean(axis=1)
    kept = box.tetrahedra[~((centre[:, 0] > 0) & (centre[:, 2] > 0))]
    used, tetrahedra = np.unique(kept, return_inverse=True)
    return TetrahedralMesh(box.nodes[used], tetrahedra.reshape(-1, 4))


def shuffled(block, seed=0):
    """The same mesh with nodes and tetrahedra in another order."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(block.nodes))
    place = np.argsort(order)
    tetrahedra = place[block.tetrahedra][rng.permutation(len(block.tetrahedra))]
    return TetrahedralMesh(block.nodes[order], tetrahedra), order
