"""Expert fingers: dimensions as asked for, valid when mounted, refused outside their ranges."""

import numpy as np
import pytest
import trimesh

from codesign_design.build import build_finger
from codesign_design.experts import (
    PAD_TIP,
    SCOOP_TIP,
    cupped_pad,
    expert,
    expert_names,
    expert_surface,
    flat_pad,
    scoop,
)
from codesign_design.finger_pair import TriangleMesh
from codesign_design.stock import stock_fingers


def solid(mesh: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def foremost(mesh: TriangleMesh, z: float) -> float:
    """Smallest y of the section at a height [m]."""
    return float(solid(mesh).section([0, 0, 1], [0, 0, z]).vertices[:, 1].min())


@pytest.mark.parametrize("name", ["flat_pad", "cupped_pad", "scoop"])
def test_surfaces_are_closed_and_start_at_gap_zero(name: str) -> None:
    surface = expert_surface(name)
    assert solid(surface).is_volume
    assert surface.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-9)
    # Left-right symmetric, as the block is.
    assert surface.vertices[:, 0].min() == pytest.approx(-surface.vertices[:, 0].max(), abs=1e-9)


def test_flat_pad_has_the_dimensions_asked_for() -> None:
    pad = solid(flat_pad(width=0.05, height=0.04, depth=0.009, edge_radius=0.001))
    np.testing.assert_allclose(pad.extents, [0.05, 0.009, 0.04], atol=1e-9)
    assert pad.bounds[1, 2] == pytest.approx(PAD_TIP)
    # A box less what the fillets along the edges take: between none and the whole rim's squares.
    rim = 2 * (0.05 + 0.04) * 0.001**2 + 4 * 0.009 * 0.001**2
    assert 0.05 * 0.04 * 0.009 - rim < pad.volume < 0.05 * 0.04 * 0.009


def test_cup_is_as_deep_as_asked_for_and_its_rim_protrudes_most() -> None:
    cup = 0.001
    mesh = cupped_pad(cup)
    middle = PAD_TIP - 0.045 / 2
    line = solid(mesh).section([1, 0, 0], [0, 0, 0]).vertices
    deepest = line[np.abs(line[:, 2] - middle) < 0.001, 1].min()
    assert deepest == pytest.approx(cup, abs=0.02 * cup)
    rim = mesh.vertices[mesh.vertices[:, 1] < 1e-5]
    assert np.abs(rim[:, 0]).max() > 0.029


def test_scoop_has_a_full_width_lip_below_its_pad() -> None:
    mesh = scoop(lip=0.010, lip_thickness=0.0015, chamfer=0.006, tip_thickness=0.0003)
    # Above the lip the pad is as far back as the lip is long; within it the wedge recedes.
    assert foremost(mesh, SCOOP_TIP - 0.020) == pytest.approx(0.010, abs=1e-6)
    assert foremost(mesh, SCOOP_TIP - 0.0002) == pytest.approx(0.0, abs=1e-6)
    half_up_the_wedge = SCOOP_TIP - (0.0003 + 0.0015) / 2
    assert foremost(mesh, half_up_the_wedge) == pytest.approx(0.003, abs=1e-6)
    tip = mesh.vertices[mesh.vertices[:, 1] < 1e-6]
    assert np.ptp(tip[:, 0]) == pytest.approx(0.060)


@pytest.mark.parametrize("name", ["flat_pad", "cupped_pad", "scoop"])
def test_mounted_experts_are_valid_and_keep_their_shape(name: str) -> None:
    built = build_finger(expert_surface(name), name)
    assert built.report.valid, built.report.problems
    assert not built.report.deviation.remeshed
    assert expert(name).content_hash == built.pair.content_hash


def test_experts_open_around_the_block_and_close_on_it() -> None:
    for name in expert_names():
        pair = expert(name)
        assert pair.min_width < 0.0059  # the scoop's lips under a 30 mm block
        assert pair.max_width > 0.038


def test_the_baseline_is_the_stock_finger() -> None:
    assert expert("stock").content_hash == stock_fingers().content_hash


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: flat_pad(width=0.3), "width is 0.3 m: must be within 0.02..0.09 m"),
        (lambda: flat_pad(edge_radius=float("nan")), "edge_radius is nan m"),
        (lambda: cupped_pad(0.01), "cup is 0.01 m"),
        (lambda: scoop(lip=0.02), "lip is 0.02 m"),
        (lambda: scoop(chamfer=0.013), "chamfer is 0.013 m: must be within 0.0..0.012 m"),
        (lambda: scoop(tip_thickness=0.002), "tip_thickness is 0.002 m"),
        (lambda: expert("spoon"), "expert surface 'spoon': unknown; there are flat_pad"),
    ],
)
def test_impossible_dimensions_are_named(make: object, said: str) -> None:
    with pytest.raises(ValueError, match=said.replace("(", r"\(")):
        make()  # type: ignore[operator]
