"""Samples and nearest points of the two surfaces of a fit."""

import igl
import numpy as np
import pytest
import torch
import trimesh

from codesign_design.design_space import design_space
from codesign_design.finger_pair import TriangleMesh
from codesign_design.fit_surfaces import Surface, Target

COUNT = 400


def random() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def bent(name: str, count: int = 3) -> tuple[Surface, torch.Tensor]:
    """A space's surface and handles of some deformed fingers, (count, N, 3)."""
    space = design_space(name)
    handles = torch.from_numpy(space.cage.handles)
    noise = torch.randn(count, *handles.shape, generator=random(), dtype=torch.float64)
    return Surface(space.weights, space.faces), handles + 0.2 * noise


def test_samples_lie_on_the_surface_with_their_weights_and_outward_normals() -> None:
    space = design_space("box-12")
    surface, handles = Surface(space.weights, space.faces), torch.from_numpy(space.cage.handles)
    samples = surface.sample(handles[None], COUNT, random())
    torch.testing.assert_close(samples.weights @ handles, samples.points)
    torch.testing.assert_close(samples.normals.norm(dim=-1), torch.ones(1, COUNT).double())
    assert (samples.normals * samples.points).sum(-1).min() > 0  # outward, from a convex body
    box = Target(TriangleMesh((space.weights @ handles).numpy(), space.faces))
    torch.testing.assert_close(box.nearest(samples.points), samples.points, rtol=0, atol=1e-12)


def test_samples_are_uniform_over_a_deformed_surface() -> None:
    surface, handles = bent("sphere-12", 1)
    drawn = surface.sample(handles, 40_000, random()).points[0]
    vertices = (surface.weights @ handles[0]).numpy()
    shape = trimesh.Trimesh(vertices, surface.faces.numpy(), process=False)
    middle = (shape.triangles_center * shape.area_faces[:, None]).sum(0) / shape.area
    # A draw sees 1200 of 5120 faces; 0.05 is 1 % of the finger's size.
    np.testing.assert_allclose(drawn.mean(0), middle, atol=0.05)


@pytest.mark.parametrize("name", ["sphere-7", "box-12", "lip-30", "torus-30"])
def test_nearest_points_are_the_whole_surfaces_but_for_a_few(name: str) -> None:
    surface, handles = bent(name)
    points = 1.5 * torch.randn(COUNT, 3, generator=random(), dtype=torch.float64)
    weights, nearest = surface.nearest(handles, points)
    torch.testing.assert_close(weights @ handles, nearest)
    torch.testing.assert_close(weights.sum(-1), torch.ones(3, COUNT).double())
    for fingers, found in zip(surface.weights @ handles, nearest, strict=True):
        squared, _, _ = igl.point_mesh_squared_distance(
            points.numpy(), fingers.numpy(), surface.faces.numpy()
        )
        excess = (found - points).norm(dim=-1).numpy() - np.sqrt(squared)
        assert excess.min() > -1e-9
        assert (excess < 1e-9).mean() > 0.8
        assert excess.mean() < 0.002  # units: 0.05 mm


def test_a_finger_is_the_same_alone_and_among_others() -> None:
    surface, handles = bent("sphere-7")
    points = torch.randn(50, 3, generator=random(), dtype=torch.float64)
    together = surface.nearest(handles, points)[1]
    alone = surface.nearest(handles[1:2], points)[1]
    torch.testing.assert_close(together[1], alone[0], rtol=0, atol=1e-12)


def test_target_samples_cover_a_cube_evenly() -> None:
    cube = trimesh.creation.box((2.0, 2.0, 2.0))
    target = Target(TriangleMesh(np.array(cube.vertices), cube.faces.astype(np.int32)))
    points, normals = target.sample(6000, random())
    torch.testing.assert_close((points * normals).sum(-1), torch.ones(6000).double())
    on_top = (normals[:, 2] > 0.5).double().mean()
    assert on_top == pytest.approx(1 / 6, abs=0.02)  # 4 standard deviations
    assert points[normals[:, 2] > 0.5][:, :2].mean(0).abs().max() < 0.08
    above = torch.tensor([[[0.3, 0.2, 5.0], [9.0, 9.0, 9.0]]], dtype=torch.float64)
    nearest = torch.tensor([[[0.3, 0.2, 1.0], [1.0, 1.0, 1.0]]], dtype=torch.float64)
    torch.testing.assert_close(target.nearest(above), nearest)
