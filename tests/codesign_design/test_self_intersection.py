"""Self-intersection: known cases, no false alarms, and agreement with a test of every pair."""

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_design.finger_pair import TriangleMesh
from codesign_design.self_intersection import intersects_itself, self_intersecting_faces


def surface(mesh: trimesh.Trimesh) -> TriangleMesh:
    return TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32))


def pair(mesh: trimesh.Trimesh, offset: tuple[float, float, float]) -> TriangleMesh:
    moved = mesh.copy()
    moved.apply_translation(offset)
    both = trimesh.util.concatenate([mesh, moved])
    assert isinstance(both, trimesh.Trimesh)
    return surface(both)


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.icosphere(subdivisions=3),
        trimesh.creation.box((1.0, 2.0, 3.0)),
        trimesh.creation.torus(1.0, 0.3),
        trimesh.creation.cylinder(1.0, 2.0, sections=64),
    ],
)
def test_neighbours_are_no_intersections(mesh: trimesh.Trimesh) -> None:
    assert not len(self_intersecting_faces(surface(mesh)))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_overlapping_boxes_intersect_at_any_scale(scale: float) -> None:
    box = trimesh.creation.box((scale, scale, scale))
    assert len(self_intersecting_faces(pair(box, (0.31 * scale, 0.22 * scale, 0.13 * scale))))
    assert not len(self_intersecting_faces(pair(box, (1.01 * scale, 0.0, 0.0))))


def test_touching_boxes_overlap_only_where_faces_are_shared() -> None:
    box = trimesh.creation.box()
    assert not len(self_intersecting_faces(pair(box, (1.0, 1.0, 0.0)))), "an edge in common"
    assert len(self_intersecting_faces(pair(box, (1.0, 0.0, 0.0)))) == 4, "the shared face, twice"


def test_a_vertex_pushed_through_the_opposite_side_is_found() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.array(sphere.vertices)
    vertices[0] *= -1.5
    found = self_intersecting_faces(TriangleMesh(vertices, sphere.faces.astype(np.int32)))
    assert len(found)
    assert set(found) & set(np.flatnonzero((sphere.faces == 0).any(axis=1)))


def test_neighbours_that_share_a_vertex_and_cut_each_other_are_found() -> None:
    vertices = np.array([[0, 0, 0], [2, -1, 0], [2, 1, 0], [1, 0, -1], [1, 0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 3, 4]], dtype=np.int32)
    assert self_intersecting_faces(TriangleMesh(vertices, faces)).tolist() == [0, 1]
    apart = vertices.copy()
    apart[3:, 2] += 2.0
    assert not len(self_intersecting_faces(TriangleMesh(apart, faces)))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_equals_a_test_of_every_pair(seed: int) -> None:
    random = np.random.default_rng(seed)
    count = 24
    centres = random.uniform(0, 3, (count, 1, 3))
    corners = centres + random.normal(size=(count, 3, 3)) * random.uniform(0.1, 1.0)
    soup = TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3))
    hit = set()
    for i in range(count):
        for j in range(i):
            a, b = ([corner.reshape(1, 3) for corner in corners[k]] for k in (i, j))
            if igl.tri_tri_intersection_test_3d(*a, *b)[0]:
                hit |= {i, j}
    assert self_intersecting_faces(soup).tolist() == sorted(hit)
    assert intersects_itself(soup) == bool(hit)
