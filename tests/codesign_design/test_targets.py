"""The five targets are closed bodies of the stated sizes."""

import numpy as np
import pytest
import trimesh

from codesign_design.finger_pair import TriangleMesh
from codesign_design.targets import SCOOP_LIP_REGION, centred, target, target_names


@pytest.mark.parametrize("name", target_names())
def test_target_is_a_closed_finger_at_the_pads_place(name: str) -> None:
    mesh = target(name)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert solid.is_watertight
    assert solid.body_count == 1
    assert solid.volume > 0
    assert 0.045 <= np.ptp(mesh.vertices[:, 2]) <= 0.050
    assert mesh.vertices[:, 1].min() == pytest.approx(0.0, abs=1e-9)
    assert mesh.vertices[:, 2].mean() == pytest.approx(-0.0175, abs=0.02)


def test_flat_has_the_volume_of_a_plate() -> None:
    mesh = target("flat")
    volume = trimesh.Trimesh(mesh.vertices, mesh.faces).volume
    assert volume * 1e9 == pytest.approx(30 * 10 * 48, rel=0.01)  # fillets take off 0.5 %


def test_cup_is_hollow_by_6_mm() -> None:
    mesh = target("cup")
    front = mesh.vertices[np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 2] + 0.0175) < 0.004]
    assert front[:, 1].max() == pytest.approx(0.006, abs=1e-4)


def test_lip_region_holds_the_lip_and_not_the_plate() -> None:
    mesh = target("scoop")
    inside = ((mesh.vertices > SCOOP_LIP_REGION[0]) & (mesh.vertices < SCOOP_LIP_REGION[1])).all(1)
    assert inside.any()
    assert mesh.vertices[inside][:, 1].max() < 0.016  # the plate's front
    assert mesh.vertices[~inside][:, 1].min() > 0.0159


def test_centring_moves_and_does_not_turn() -> None:
    mesh = target("wedge")
    moved = TriangleMesh(mesh.vertices + np.array([0.01, -0.02, 0.3]), mesh.faces)
    np.testing.assert_allclose(centred(moved).vertices, mesh.vertices, atol=1e-12)


def test_unknown_target_is_refused() -> None:
    with pytest.raises(ValueError, match="no target 'hook'; choose from flat, cup"):
        target("hook")
