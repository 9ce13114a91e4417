"""Mean value coordinates against the properties that define them."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from codesign_design.cage import cage_names, load_cage
from codesign_design.coordinates import mean_value_coordinates
from codesign_design.design_space import design_space


def cage(name: str) -> tuple[Tensor, Tensor]:
    data = load_cage(name)
    return torch.from_numpy(data.handles), torch.from_numpy(data.faces.astype(np.int64))


def points_inside(seed: int, count: int = 20) -> Tensor:
    """Points in the ball of radius 0.95, which every cage of the sphere contains."""
    random = torch.Generator().manual_seed(seed)
    direction = torch.randn(count, 3, generator=random, dtype=torch.float64)
    radius = torch.rand(count, 1, generator=random, dtype=torch.float64) ** (1 / 3)
    return 0.95 * radius * direction / direction.norm(dim=1, keepdim=True)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), name=st.sampled_from(["sphere-7", "sphere-12", "sphere-30"]))
def test_reproduce_affine_motions_and_are_positive_around_the_sphere(seed: int, name: str) -> None:
    handles, faces = cage(name)
    points = points_inside(seed)
    weights = mean_value_coordinates(points, handles, faces)
    random = torch.Generator().manual_seed(seed)
    matrix = torch.randn(3, 3, generator=random, dtype=torch.float64)
    shift = torch.randn(3, generator=random, dtype=torch.float64)
    torch.testing.assert_close(
        weights.sum(-1), torch.ones(20, dtype=torch.float64), rtol=0, atol=1e-14
    )
    torch.testing.assert_close(weights @ handles, points, rtol=0, atol=1e-13)
    torch.testing.assert_close(
        weights @ (handles @ matrix + shift), points @ matrix + shift, rtol=0, atol=1e-12
    )
    assert weights.min() > 0.0


@pytest.mark.parametrize("name", cage_names())
def test_of_the_base_meshes_reproduce_them_and_have_full_rank(name: str) -> None:
    space = design_space(name)
    rest = space.weights @ torch.from_numpy(space.cage.handles)
    centred = space.deform(torch.zeros(1, space.parameter_count, dtype=torch.float64))[0]
    torch.testing.assert_close(
        space.weights.sum(1), torch.ones(len(rest), dtype=torch.float64), rtol=0, atol=1e-14
    )
    assert np.linalg.matrix_rank(space.weights.numpy()) == space.handles
    size = (rest.max(0).values - rest.min(0).values).numpy()
    np.testing.assert_allclose(np.ptp(centred.numpy(), axis=0), size * 0.024, atol=1e-12)


@pytest.mark.parametrize("name", cage_names())
def test_at_a_handle_only_that_handle_counts(name: str) -> None:
    handles, faces = cage(name)
    weights = mean_value_coordinates(handles, handles, faces)
    torch.testing.assert_close(
        weights, torch.eye(len(handles), dtype=torch.float64), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("name", ["sphere-7", "lip-12", "torus-30"])
def test_on_a_face_only_its_corners_count(name: str) -> None:
    handles, faces = cage(name)
    shares = torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64)
    points = (handles[faces] * shares[:, None]).sum(1)
    weights = mean_value_coordinates(points, handles, faces)
    expected = torch.zeros_like(weights).scatter_(1, faces, shares.expand(len(faces), 3))
    torch.testing.assert_close(weights, expected, rtol=0, atol=1e-12)


def test_approach_the_face_values_continuously() -> None:
    handles, faces = cage("sphere-12")
    corners = handles[faces[0]]
    shares = torch.tensor([[0.2, 0.3, 0.5]], dtype=torch.float64)
    point = shares @ corners
    near = mean_value_coordinates(point * (1 - 1e-6), handles, faces)
    on = mean_value_coordinates(point, handles, faces)
    assert (near - on).abs().max() < 1e-5


def test_are_unchanged_by_moving_turning_and_scaling_everything() -> None:
    handles, faces = cage("sphere-30")
    points = points_inside(3)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64)).Q
    turn = turn * torch.linalg.det(turn).sign()  # a rotation, not a reflection
    moved = [5.0 * value @ turn + 7.0 for value in (points, handles)]
    torch.testing.assert_close(
        mean_value_coordinates(moved[0], moved[1], faces),
        mean_value_coordinates(points, handles, faces),
        rtol=0,
        atol=1e-11,
    )


def test_take_a_batch() -> None:
    handles, faces = cage("sphere-7")
    points = points_inside(4).reshape(4, 5, 3)
    weights = mean_value_coordinates(points, handles, faces)
    assert weights.shape == (4, 5, 7)
    torch.testing.assert_close(weights[2], mean_value_coordinates(points[2], handles, faces))


def test_refuse_single_precision() -> None:
    handles, faces = cage("sphere-7")
    with pytest.raises(ValueError, match=r"points are torch\.float32.*pass float64"):
        mean_value_coordinates(torch.zeros(1, 3), handles, faces)
