"""Poisson reconstruction: a solver with a known solution, and shapes whose size is known."""

import numpy as np
import pytest
import trimesh

from codesign_design.build import build_finger
from codesign_design.design_space import design_space
from codesign_design.finger_pair import TriangleMesh
from codesign_design.mesh_checks import edge_checks, volume_and_centre
from codesign_design.poisson import _poisson, reconstruct

RADIUS = 0.012  # m


def ball() -> TriangleMesh:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return TriangleMesh(np.array(sphere.vertices), np.array(sphere.faces, np.int32))


def test_a_sine_solves_its_own_equation() -> None:
    """sin(a i) sin(b j) sin(c k) is an eigenfunction of the seven-point Laplacian."""
    shape, modes = (9, 12, 7), (2, 3, 1)
    angles = [np.pi * m / (n + 1) for m, n in zip(modes, shape, strict=True)]
    i, j, k = np.meshgrid(*(np.arange(1, n + 1) for n in shape), indexing="ij")
    wave = np.sin(angles[0] * i) * np.sin(angles[1] * j) * np.sin(angles[2] * k)
    eigenvalue = sum(2.0 * np.cos(angle) - 2.0 for angle in angles)
    np.testing.assert_allclose(_poisson(eigenvalue * wave), wave, atol=1e-12)


def test_a_ball_comes_back() -> None:
    """To a tenth of the voxel of 1 mm."""
    made = reconstruct(ball())
    radii = np.linalg.norm(made.mesh.vertices, axis=1)
    assert np.abs(radii - RADIUS).max() < 1.5e-4
    assert radii.mean() == pytest.approx(RADIUS, abs=5e-5)
    assert made.volume == pytest.approx(volume_and_centre(ball())[0], rel=0.01)
    assert made.lost == 0.0


def test_a_hole_is_closed() -> None:
    whole = ball()
    middle = whole.vertices[whole.faces].mean(axis=1)
    cap = middle[:, 2] > 0.97 * RADIUS  # 6 mm across
    torn = TriangleMesh(whole.vertices, whole.faces[~cap])
    assert not all(edge_checks(torn.faces))
    made = reconstruct(torn)
    assert all(edge_checks(made.mesh.faces))
    assert volume_and_centre(made.mesh)[0] == pytest.approx(volume_and_centre(whole)[0], rel=0.02)


def test_equal_seeds_give_equal_surfaces() -> None:
    first, second = (reconstruct(ball(), seed=3).mesh for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)


def test_an_inside_out_surface_is_refused() -> None:
    whole = ball()
    with pytest.raises(ValueError, match="turn its faces outward"):
        reconstruct(TriangleMesh(whole.vertices, whole.faces[:, ::-1]))


def test_a_finger_is_built_from_it() -> None:
    space = design_space("sphere-7")
    surface = space.surface(np.zeros(space.parameter_count))
    built = build_finger(surface, poisson=True)
    assert built.report.mesh.valid
    assert built.report.deviation.remeshed
    assert built.report.deviation.mean < 1e-4
    assert not build_finger(surface).report.deviation.remeshed
