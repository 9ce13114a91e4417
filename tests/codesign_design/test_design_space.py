"""Design spaces: parameters to surfaces."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_design.design_space import CENTRE, DISPLACEMENT_SCALE, design_space


def test_zero_is_the_unit_sphere_48_mm_across_at_the_pads_place() -> None:
    space = design_space("sphere-7")
    points = space.deformed(np.zeros(21)).vertices
    np.testing.assert_allclose(np.linalg.norm(points - CENTRE, axis=1), 0.024, atol=1e-12)
    assert CENTRE[2] == pytest.approx(-0.0175, abs=1e-4)


def test_surface_touches_the_closing_plane() -> None:
    space = design_space("lip-12")
    parameters = np.random.default_rng(0).uniform(-0.1, 0.1, space.parameter_count)
    mesh = space.surface(parameters)
    assert mesh.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-15)
    offset = mesh.vertices - space.deformed(parameters).vertices
    np.testing.assert_allclose(offset - offset[0], 0.0, atol=1e-15)
    assert np.allclose(offset[0, [0, 2]], 0.0)


def test_moving_every_handle_moves_the_surface_by_the_scale() -> None:
    space = design_space("box-12")
    parameters = np.tile([0.1, -0.05, 0.2], space.handles)
    moved = space.deformed(parameters).vertices - space.deformed(np.zeros(36)).vertices
    expected = np.array([0.1, -0.05, 0.2]) * DISPLACEMENT_SCALE * 0.024
    np.testing.assert_allclose(moved, np.broadcast_to(expected, moved.shape), atol=1e-12)


def test_batched_deformation_is_the_single_one_and_its_gradient_the_weights() -> None:
    space = design_space("sphere-12")
    random = torch.Generator().manual_seed(0)
    parameters = 0.2 * torch.randn(3, 36, generator=random, dtype=torch.float64)
    vertices = space.deform(parameters)
    np.testing.assert_allclose(
        vertices[1].numpy(), space.deformed(parameters[1].numpy()).vertices, atol=1e-15
    )
    one = parameters[:1].clone().requires_grad_()
    space.deform(one)[0, 100, 1].backward()
    assert one.grad is not None
    gradient = one.grad.reshape(12, 3)
    torch.testing.assert_close(gradient[:, 1], space.weights[100] * space.scale)
    assert (gradient[:, [0, 2]] == 0).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_handles_and_parameters_are_inverse(seed: int) -> None:
    space = design_space("torus-7")
    parameters = np.random.default_rng(seed).uniform(-1.0, 1.0, 21) * 0.999
    handles = space.handles_at(parameters)
    np.testing.assert_allclose(space.parameters_of(handles), parameters, atol=1e-13)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros(20), r"shape \(20,\); sphere-7 takes \(21,\)"),
        (np.zeros((7, 3)), r"shape \(7, 3\)"),
        (["a"] * 21, "must be 21 numbers"),
        (np.r_[np.zeros(4), np.nan, np.zeros(16)], r"parameter 4 is nan.*axis y of handle 1"),
        (np.r_[np.zeros(20), 1.01], r"parameter 20 is 1\.01; .* \+-1 \(axis z of handle 6\)"),
        (np.r_[-np.inf, np.zeros(20)], "parameter 0 is -inf"),
    ],
)
def test_wrong_parameters_are_named(values: np.ndarray, message: str) -> None:
    space = design_space("sphere-7")
    for method in (space.check, space.surface, space.handles_at):
        with pytest.raises(ValueError, match=message):
            method(values)


def test_unknown_space_is_refused() -> None:
    with pytest.raises(ValueError, match="no cage 'sphere-9'; choose from"):
        design_space("sphere-9")
