"""The stock finger against the measured figures, and against the gripper that carries it."""

import numpy as np
import pytest
import trimesh

from codesign_control import GripperModel
from codesign_control.gripper import DRIVE_LIMIT
from codesign_design import stock
from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_design.stock import stock_fingers


def as_trimesh(mesh: TriangleMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("side", ["left", "right"])
def test_is_one_watertight_body_with_the_measured_volume(side: str) -> None:
    mesh = as_trimesh(getattr(stock_fingers(), side))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    # 29.5 x 37.5 x 2 mm pad on a 32 x 46 x 5 mm frame; edges and corners take off up to 1 %.
    assert mesh.volume == pytest.approx(9.5725e-6, rel=0.01)
    assert mesh.volume < 9.5725e-6


def test_pad_is_flat_and_of_the_measured_size() -> None:
    left = stock_fingers().left
    face = left.vertices[np.isclose(left.vertices[:, 1], 0.0, atol=1e-12)]
    flat = 2 * stock.EDGE_RADIUS  # the fillets on either side do not belong to the flat part
    assert np.ptp(face[:, 0]) == pytest.approx(0.0295 - flat, abs=1e-9)
    assert np.ptp(face[:, 2]) == pytest.approx(0.0375 - flat, abs=1e-9)


def test_fingers_are_mirror_images_on_either_side_of_the_gap() -> None:
    fingers = stock_fingers()
    assert fingers.left.vertices[:, 1].min() == 0.0
    assert fingers.right.vertices[:, 1].max() == 0.0
    assert np.array_equal(fingers.left.vertices * [1, -1, 1], fingers.right.vertices)


def test_place_in_the_grasp_frame_is_the_grippers() -> None:
    link_z = GripperModel.finger_position(DRIVE_LIMIT)[1] - 0.172
    assert pytest.approx(link_z, abs=1e-6) == stock.LINK_Z
    assert stock_fingers().protrusion == pytest.approx(0.026)


@pytest.mark.parametrize("radius", [0.0, -0.001, 0.002, float("nan")])
def test_refuses_an_edge_radius_that_does_not_fit(radius: float) -> None:
    with pytest.raises(ValueError, match="edge radius"):
        stock_fingers(radius)


def test_content_hash_tells_shapes_apart_and_not_names() -> None:
    a, b = stock_fingers(), stock_fingers(0.0008)
    renamed = FingerPair("other", a.left, a.right, a.min_width, a.max_width)
    assert a.content_hash == renamed.content_hash == stock_fingers().content_hash
    assert a.content_hash != b.content_hash
