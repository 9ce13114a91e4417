"""The tetrahedral mesh of the block."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_sim import Block

blocks = st.builds(
    Block,
    size=st.tuples(*[st.floats(0.01, 0.1)] * 3),
    cells=st.tuples(*[st.integers(1, 4)] * 3),
)


@settings(max_examples=30, deadline=None)
@given(blocks)
def test_tetrahedra_fill_the_box(block):
    assert (block.volumes > 0).all()
    assert block.volumes.sum() == pytest.approx(block.volume)
    assert len(block.tetrahedra) == block.resolution


@settings(max_examples=30, deadline=None)
@given(blocks)
def test_surface_is_the_boxs_and_winds_outwards(block):
    # Neighbouring cells whose diagonals did not meet would leave inner faces on the surface.
    x, y, z = block.size
    assert block.surface_areas.sum() == pytest.approx(2 * (x * y + y * z + z * x))
    a, b, c = (block.nodes[block.surface_triangles[:, k]] for k in range(3))
    enclosed = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert enclosed == pytest.approx(block.volume)


@settings(max_examples=30, deadline=None)
@given(blocks)
def test_surface_tetrahedra_hold_their_triangles(block):
    behind = block.tetrahedra[block.surface_tetrahedra]
    for triangle, tet in zip(block.surface_triangles, behind, strict=True):
        assert set(triangle) <= set(tet)


@settings(max_examples=30, deadline=None)
@given(blocks)
def test_lumped_volumes_keep_mass_and_centre(block):
    for lumped in (block.node_volumes, block.load_volumes):
        assert lumped.sum() == pytest.approx(block.volume)
        assert np.allclose(lumped @ block.nodes, 0, atol=1e-9 * block.volume)


def test_inverse_edges_undo_the_rest_shape():
    block = Block.tofu(600)
    x = block.nodes[block.tetrahedra]
    edges = np.transpose(x[:, 1:] - x[:, :1], (0, 2, 1))
    assert np.allclose(edges @ block.inverse_edges, np.eye(3))


@pytest.mark.parametrize("tets", [600, 2400, 8100, 19200])
def test_tofu_resolutions(tets):
    block = Block.tofu(tets)
    assert block.resolution == len(block.tetrahedra) == tets
    assert block.size == (0.05, 0.03, 0.04)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"size": (0.05, 0.0, 0.04)}, "block size is 0 m; it must be above 0"),
        ({"size": (0.05, 0.03)}, r"block size has shape \(2,\); it must be \(3,\)"),
        ({"size": (0.05, np.nan, 0.04)}, "block size contains nan"),
        ({"cells": (4, 0, 4)}, "use whole numbers of at least 1"),
        ({"cells": (4, 2.5, 4)}, "use whole numbers of at least 1"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        Block(**arguments)


def test_unknown_resolution_is_named():
    with pytest.raises(ValueError, match="no tofu mesh of 1000 tetrahedra; choose one of"):
        Block.tofu(1000)
