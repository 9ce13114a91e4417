"""Checks of finger surfaces."""

import numpy as np
import pytest

from codesign_sim import SurfaceMesh

CUBE = SurfaceMesh.box((0, 0, 0), (1, 1, 1))


def test_box_spans_its_corners():
    box = SurfaceMesh.box((-1, 0, 2), (1, 3, 4))
    assert np.allclose(box.vertices.min(axis=0), [-1, 0, 2])
    assert np.allclose(box.vertices.max(axis=0), [1, 3, 4])


def test_equal_content_has_an_equal_hash():
    again = SurfaceMesh(CUBE.vertices.copy(), CUBE.faces.copy())
    moved = SurfaceMesh(CUBE.vertices + 1e-6, CUBE.faces)
    assert again.content_hash == CUBE.content_hash != moved.content_hash


def test_a_hole_is_named_with_its_edges():
    with pytest.raises(ValueError, match=r"not watertight: 3 edges .* close the holes"):
        SurfaceMesh(CUBE.vertices, CUBE.faces[:-1])


def test_inward_winding_is_named():
    with pytest.raises(ValueError, match=r"volume is -1 m.*reverse the faces"):
        SurfaceMesh(CUBE.vertices, CUBE.faces[:, ::-1])


def test_mixed_winding_is_named():
    faces = CUBE.faces.copy()
    faces[0] = faces[0, ::-1]
    with pytest.raises(ValueError, match="wound inconsistently"):
        SurfaceMesh(CUBE.vertices, faces)


def test_numbers_that_are_not_finite_are_named():
    vertices = CUBE.vertices.copy()
    vertices[3, 1] = np.nan
    with pytest.raises(ValueError, match="mesh vertices contains nan"):
        SurfaceMesh(vertices, CUBE.faces)


def test_missing_vertices_are_named():
    with pytest.raises(ValueError, match="names vertex 7, but there are only 7"):
        SurfaceMesh(CUBE.vertices[:7], CUBE.faces)


def test_shapes_are_named():
    with pytest.raises(ValueError, match=r"mesh vertices has shape \(8, 2\)"):
        SurfaceMesh(CUBE.vertices[:, :2], CUBE.faces)
    with pytest.raises(ValueError, match="mesh has 0 faces"):
        SurfaceMesh(CUBE.vertices, np.zeros((0, 3)))
