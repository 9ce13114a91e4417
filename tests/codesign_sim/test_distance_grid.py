"""Signed distance grids against shapes with known distances."""

import numpy as np
import pytest
import trimesh

from codesign_sim import SurfaceMesh
from codesign_sim.distance import SPACING, bake
from codesign_sim.surface_queries import BAND


def test_sphere():
    radius = 0.012
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    grid = bake(SurfaceMesh(sphere.vertices, sphere.faces))
    rng = np.random.default_rng(0)
    direction = rng.standard_normal((500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = rng.uniform(-0.0012, 0.001, 500)
    measured = grid.sample(direction * (radius + distance)[:, None])
    # The facets lie up to radius * 0.0017 inside; trilinear cells add (1 mm)^2 / 8 radius.
    assert np.abs(measured - distance).max() < 4e-5


def test_box_distances_are_exact_beside_flat_faces():
    low, high = np.array([-0.01, 0.0, -0.0123]), np.array([0.01, 0.0077, 0.0123])
    grid = bake(SurfaceMesh.box(tuple(low), tuple(high)))
    rng = np.random.default_rng(1)
    points = rng.uniform(low + 0.003, high - 0.003, (300, 3))
    points[:, 1] = rng.uniform(-0.0009, 0.002, 300)
    assert np.allclose(grid.sample(points), -points[:, 1], atol=1e-7)


def test_signs_of_every_cell_of_a_box():
    low, high = np.array([-0.01, 0.0, -0.01]), np.array([0.01, 0.01, 0.01])
    grid = bake(SurfaceMesh.box(tuple(low), tuple(high)))
    axes = [grid.origin[k] + SPACING * np.arange(n) for k, n in enumerate(grid.values.shape[::-1])]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    points = np.stack([x, y, z], axis=-1)
    outside = np.maximum(low - points, points - high).max(axis=-1)
    clear = np.abs(outside) > 1e-6
    assert ((grid.values > 0) == (outside > 0))[clear].all()


def test_distances_beyond_the_band_go_on_growing():
    grid = bake(SurfaceMesh.box((-0.01, -0.01, -0.01), (0.01, 0.01, 0.01)))
    inwards = np.linspace(0, 0.009, 19)
    points = np.column_stack([0.01 - inwards, np.full(19, 1e-4), np.full(19, 2e-4)])
    depth = -grid.sample(points)
    assert inwards.max() > BAND
    assert (np.diff(depth) > 0).all()
    assert np.allclose(depth, inwards, atol=SPACING)


def test_outside_the_grid_is_infinitely_far():
    grid = bake(SurfaceMesh.box((-0.01, -0.01, -0.01), (0.01, 0.01, 0.01)))
    assert np.isposinf(grid.sample(np.array([[0.0, 0.0, 0.1]]))).all()


def test_equal_meshes_share_a_grid():
    mesh = SurfaceMesh.box((0, 0, 0), (0.01, 0.01, 0.01))
    again = SurfaceMesh(mesh.vertices.copy(), mesh.faces.copy())
    assert bake(mesh) is bake(again)


def test_a_mesh_in_millimetres_is_named():
    with pytest.raises(ValueError, match="is the mesh in metres"):
        bake(SurfaceMesh.box((0, 0, 0), (20, 20, 50)))
