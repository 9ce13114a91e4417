"""Inverse design: fits to shapes whose parameters are known, and the terms of the fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign_design.chamfer import distances_to
from codesign_design.design_space import design_space
from codesign_design.finger_pair import TriangleMesh
from codesign_design.fit_options import FitOptions
from codesign_design.fit_surfaces import Samples, Surface
from codesign_design.inverse import fit
from codesign_design.matching import chamfer_rows, closing_rows, wall_rows
from codesign_design.targets import SCOOP_LIP_REGION, target

QUICK = FitOptions(restarts=6, iterations=24, samples=150, polished=1, polish_iterations=25)


@pytest.fixture(scope="module")
def known() -> TriangleMesh:
    """A finger that the 7-handle box space can make exactly."""
    space = design_space("box-7")
    parameters = np.random.default_rng(1).uniform(-0.06, 0.06, space.parameter_count)
    return space.deformed(parameters)


@pytest.mark.parametrize(("method", "limit"), [("icp", 0.06), ("adam", 0.12)])
def test_recovers_a_shape_of_its_own_space(known: TriangleMesh, method: str, limit: float) -> None:
    space = design_space("box-7")
    shares: list[float] = []
    result = fit(space, known, replace(QUICK, method=method), progress=shares.append)
    assert result.chamfer * 1e3 < limit  # mm; 2.5 mm before fitting
    assert result.iou > 0.97
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert result.curve[-1] < 0.2 * result.curve[0]


def test_result_is_consistent_and_repeatable(known: TriangleMesh) -> None:
    space = design_space("box-7")
    options = replace(QUICK, restarts=2, polish_iterations=4, seed=5)
    first, second = (fit(space, known, options) for _ in range(2))
    assert np.array_equal(first.parameters, second.parameters)
    other = fit(space, known, replace(options, seed=6))
    assert not np.array_equal(first.parameters, other.parameters)
    np.testing.assert_allclose(
        space.deformed(first.parameters).vertices, first.surface.vertices, atol=1e-12
    )
    assert first.others.min() == first.chamfer


def test_region_decides_between_fits_that_are_alike() -> None:
    space, scoop = design_space("lip-12"), target("scoop")
    options = replace(QUICK, restarts=4, polished=2)
    result = fit(space, scoop, options, region=SCOOP_LIP_REGION)
    assert result.chamfer <= 1.1 * result.others.min()
    assert result.region_iou is not None
    assert result.region_iou > 0.6


def test_emphasis_on_a_region_brings_the_surface_closer_there() -> None:
    space, scoop = design_space("lip-7"), target("scoop")  # too few handles for all of it
    options = replace(QUICK, polished=2)
    lip = np.array([p for p in scoop.vertices if (p > SCOOP_LIP_REGION[0]).all()])
    lip = lip[(lip < SCOOP_LIP_REGION[1]).all(1)]
    plain = fit(space, scoop, options)
    keen = fit(space, scoop, options, region=SCOOP_LIP_REGION)
    away = [distances_to(lip, each.surface).mean() for each in (plain, keen)]
    assert away[1] < 0.9 * away[0]


def test_keeps_within_the_bounds() -> None:
    far = target("flat")
    moved = TriangleMesh(far.vertices + np.array([0.0, 0.25, 0.0]), far.faces)
    result = fit(design_space("sphere-7"), moved, replace(QUICK, polish_iterations=2))
    assert np.abs(result.parameters).max() <= 0.75 + 1e-12


def test_an_open_target_is_refused_with_the_number_of_its_open_edges(known: TriangleMesh) -> None:
    holed = TriangleMesh(known.vertices, known.faces[1:])
    message = "the target is not closed: of .* edges 3 are open and 0 belong to more than two"
    with pytest.raises(ValueError, match=message):
        fit(design_space("box-7"), holed, QUICK)


def flat_samples(space_name: str = "box-12") -> Samples:
    space = design_space(space_name)
    handles = torch.from_numpy(space.cage.handles)[None]
    surface = Surface(space.weights, space.faces)
    return surface.sample(handles, 400, torch.Generator().manual_seed(0))


def test_normals_keep_the_faces_of_a_thin_plate_apart() -> None:
    samples = flat_samples()
    up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    point = torch.tensor([[0.0, 0.29, 0.0]], dtype=torch.float64)  # near the back (y = +0.29)
    facing = -up[None]  # but looking to the front
    blind = chamfer_rows(samples, point, facing, normal_weight=0.0)
    seeing = chamfer_rows(samples, point, facing, normal_weight=2.0)
    matched_blind = (blind.weights[:, -1] @ torch.from_numpy(design_space("box-12").cage.handles))[
        0
    ]
    matched = (seeing.weights[:, -1] @ torch.from_numpy(design_space("box-12").cage.handles))[0]
    assert matched_blind[1] > 0.2
    assert matched[1] < -0.2


def test_wall_rows_ask_thin_walls_to_be_thicker() -> None:
    samples, handles = flat_samples(), torch.from_numpy(design_space("box-12").cage.handles)[None]
    thickness = 14.0 / 24.0  # of the box, units
    assert wall_rows(samples, 0.8 * thickness, 1.0).importance.sum() == 0
    rows = wall_rows(samples, 1.5 * thickness, 1.0)
    asked = rows.importance[0] > 0
    assert asked.float().mean() > 0.3
    gap = ((rows.weights @ handles) * rows.directions).sum(-1)[0, asked]
    assert gap.max() < 1.5 * thickness
    front = rows.directions[0, asked][:, 1].abs() > 0.99
    assert gap[front].median() == pytest.approx(thickness, rel=0.02)


def test_closing_rows_push_back_what_protrudes() -> None:
    samples = flat_samples()
    rows = closing_rows(samples, plane=0.0, importance=2.0)
    beyond = samples.points[0, :, 1] < 0
    assert ((rows.importance[0] > 0) == beyond).all()
    assert (rows.goals[0, :, 1] == 0).all()


def test_closing_penalty_is_heeded(known: TriangleMesh) -> None:
    space = design_space("box-7")
    moved = TriangleMesh(
        known.vertices - [0.0, known.vertices[:, 1].min() + 0.003, 0.0], known.faces
    )
    free = fit(space, moved, replace(QUICK, restarts=3))
    kept = fit(space, moved, replace(QUICK, restarts=3, closing=True))
    assert free.surface.vertices[:, 1].min() < -0.0025
    assert kept.surface.vertices[:, 1].min() > 0.6 * free.surface.vertices[:, 1].min()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "method 'magic': choose icp or adam"),
        ({"restarts": 0}, "restarts is 0; it must be at least 1"),
        ({"wall": -0.001}, r"wall is -0\.001 m; it must be within"),
    ],
)
def test_wrong_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FitOptions(**options)
