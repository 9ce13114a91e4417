"""The grasp frame stays where it is asked to while the four-bar moves the fingers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codesign_control import GripperModel, Pose, Xarm7
from codesign_control.grasp_frame import grasp_pose, start_posture, tcp_translation

ARM, GRIPPER = Xarm7(), GripperModel()
widths = st.floats(0.002, 0.085)
small = st.floats(-0.007, 0.007)
angle = st.floats(-0.025, 0.025)


def test_is_link_tcp_when_closed() -> None:
    grasp, tcp = grasp_pose(ARM, GRIPPER, ARM.home, 0.0), ARM.fk_tcp(ARM.home)
    np.testing.assert_allclose(grasp.position, tcp.position, atol=1e-9)


def test_open_fingers_are_12_mm_nearer_to_the_arm() -> None:
    grasp = grasp_pose(ARM, GRIPPER, ARM.home, GRIPPER.max_width)
    # The tool points down at home: nearer to the arm is up.
    rise = grasp.position[2] - ARM.fk_tcp(ARM.home).position[2]
    assert rise == pytest.approx(0.01235, abs=2e-5)


@given(before=widths, after=widths, move=st.tuples(small, small, small),
       turn=st.tuples(angle, angle, angle))  # fmt: skip
def test_arm_makes_up_for_the_four_bar(
    before: float, after: float, move: tuple[float, ...], turn: tuple[float, ...]
) -> None:
    """Displacing link_tcp as told displaces the grasp frame as asked."""
    import pinocchio as pin

    start = ARM.fk_tcp(ARM.home)
    rotation = np.array(turn)
    shift = tcp_translation(start, GRIPPER, np.array(move), rotation, before, after)
    turned = pin.exp3(rotation) @ start.rotation

    def grasp(position: np.ndarray, orientation: np.ndarray, width: float) -> np.ndarray:
        return position + orientation[:, 2] * GRIPPER.finger_z(width)

    was = grasp(start.position, start.rotation, before)
    is_now = grasp(start.position + shift, turned, after)
    np.testing.assert_allclose(is_now - was, move, atol=1e-12)


def test_pure_closing_moves_the_arm_along_the_tool_only() -> None:
    start = Pose(np.array([0.4, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0]))
    shift = tcp_translation(start, GRIPPER, np.zeros(3), np.zeros(3), 0.06, 0.0273)
    expected = GRIPPER.finger_z(0.06) - GRIPPER.finger_z(0.0273)
    # Tool z is down: the arm rises by what the fingers come out.
    np.testing.assert_allclose(shift, [0.0, 0.0, -expected], atol=1e-12)
    assert shift[2] > 0.0


@pytest.mark.parametrize("protrusion", [0.026, 0.030, 0.034])
def test_every_finger_starts_where_the_stock_one_does(protrusion: float) -> None:
    stock = grasp_pose(ARM, GRIPPER, ARM.home, 0.06)
    fingers = GripperModel(protrusion)
    joints = start_posture(ARM, fingers, 0.06)
    here = grasp_pose(ARM, fingers, joints, 0.06)
    np.testing.assert_allclose(here.position, stock.position, atol=1e-5)
    np.testing.assert_allclose(here.rotation, stock.rotation, atol=1e-4)
    assert np.abs(joints - ARM.home).max() < 0.1
