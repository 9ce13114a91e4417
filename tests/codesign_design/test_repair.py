"""Repair: known volumes, signs and shapes; always one valid piece."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_design.columns import Columns, winding_numbers
from codesign_design.design_space import design_space
from codesign_design.finger_pair import TriangleMesh
from codesign_design.mesh_checks import check_mesh
from codesign_design.repair import repair, smoothed

RADIUS = 0.015  # m


def sphere(offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    ball.apply_translation(offset)
    return ball


def surface(*meshes: trimesh.Trimesh) -> TriangleMesh:
    mesh = trimesh.util.concatenate(list(meshes))
    assert isinstance(mesh, trimesh.Trimesh)
    return TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int32))


def grid(half: float, step: float) -> np.ndarray:
    return np.arange(-half, half, step)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_winding_numbers_of_overlapping_and_inverted_spheres(axis: int) -> None:
    second = sphere((0.012, 0.0, 0.0))
    inverted = sphere((0.0, 0.0, 0.034))
    inverted.invert()
    line = grid(0.055, 0.00137)
    winding = winding_numbers(surface(sphere(), second, inverted), Columns(axis, line, line), line)
    # Back to x, y, z: the array's axes are axis + 1, axis + 2, axis.
    winding = np.moveaxis(winding, (0, 1, 2), ((axis + 1) % 3, (axis + 2) % 3, axis))
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    expected = np.zeros(winding.shape, dtype=int)
    certain = np.ones(winding.shape, dtype=bool)
    for centre, sign in (((0, 0, 0), 1), ((0.012, 0, 0), 1), ((0, 0, 0.034), -1)):
        distance = np.linalg.norm(points - centre, axis=-1)
        expected += sign * (distance < RADIUS)
        certain &= np.abs(distance - RADIUS) > 0.0003  # facets are inside the sphere
    assert np.array_equal(winding[certain], expected[certain])
    assert set(np.unique(winding)) == {-1, 0, 1, 2}


def test_a_column_through_edges_and_vertices_is_counted_once() -> None:
    box = surface(trimesh.creation.box((2.0, 2.0, 2.0)))
    line = np.array([-1.5, -0.5, 0.0, 0.5, 1.5])  # the faces' diagonals run through the columns
    winding = winding_numbers(box, Columns(2, line, line), np.array([-1.5, 0.0, 1.5]))
    expected = np.zeros((5, 5, 3), dtype=int)
    expected[1:4, 1:4, 1] = 1
    assert np.array_equal(winding, expected)


def test_sphere_keeps_its_volume_and_centre() -> None:
    ball = surface(sphere())
    checks = check_mesh(smoothed(repair(ball).mesh, 10))
    assert checks.valid
    assert checks.genus == 0
    assert checks.volume == pytest.approx(check_mesh(ball).volume, rel=0.005)
    assert checks.centre_of_mass == pytest.approx((0, 0, 0), abs=5e-5)


def test_overlapping_spheres_become_their_union() -> None:
    apart = 0.012
    both = surface(sphere(), sphere((apart, 0.0, 0.0)))
    assert check_mesh(both).self_intersecting_faces
    checks = check_mesh(smoothed(repair(both).mesh, 10))
    lens = np.pi * (4 * RADIUS + apart) * (2 * RADIUS - apart) ** 2 / 12
    union = 8 / 3 * np.pi * RADIUS**3 - lens
    assert checks.valid
    assert checks.volume == pytest.approx(union, rel=0.015)


def test_cavities_are_filled_and_small_pieces_dropped_and_reported() -> None:
    hollow = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS / 2)
    hollow.invert()
    crumb = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS / 3)
    crumb.apply_translation((0.0, 0.0, 0.03))
    repaired = repair(surface(sphere(), hollow, crumb))
    checks = check_mesh(repaired.mesh)
    assert checks.valid
    assert checks.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.015)
    # Of the shell's 7/8 and the crumb's 1/27 of a ball, the crumb is lost.
    assert repaired.lost == pytest.approx((1 / 27) / (7 / 8 + 1 / 27), rel=0.1)


def test_a_hole_is_closed_by_the_generalised_winding_number() -> None:
    ball = surface(sphere())
    faces = np.delete(ball.faces, [0, 1, 2], axis=0)
    checks = check_mesh(smoothed(repair(TriangleMesh(ball.vertices, faces)).mesh, 10))
    assert checks.valid
    assert checks.volume == pytest.approx(check_mesh(ball).volume, rel=0.01)


def test_what_is_too_deep_is_left_out() -> None:
    mesh = repair(surface(sphere()), depth=0.010).mesh
    assert 0.010 < np.ptp(mesh.vertices[:, 1]) < 0.014
    assert check_mesh(mesh).valid


def test_inside_out_surface_is_refused() -> None:
    ball = surface(sphere())
    with pytest.raises(ValueError, match="turn its faces outward"):
        repair(TriangleMesh(ball.vertices, ball.faces[:, ::-1].copy()))


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["sphere-7", "sphere-30", "lip-12"]))
def test_wild_designs_become_one_valid_piece(seed: int, name: str) -> None:
    space = design_space(name)
    random = np.random.default_rng(seed)
    parameters = np.clip(random.normal(0, 0.3, space.parameter_count), -1, 1)
    checks = check_mesh(smoothed(repair(space.surface(parameters)).mesh, 0))
    assert checks.watertight
    assert checks.winding_consistent
    assert checks.components == 1
