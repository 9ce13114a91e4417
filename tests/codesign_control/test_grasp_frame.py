"""The grasp frame stays between the fingers while the gripper's four-bar moves them."""

import numpy as np
import pytest

from codesign_control import GripperModel, Pose, Xarm7
from codesign_control.grasp_frame import grasp_pose, tcp_translation


def test_closed_stock_fingers_grasp_at_the_tcp(arm: Xarm7) -> None:
    gripper = GripperModel()
    grasp = grasp_pose(arm, gripper, arm.home, gripper.min_width)
    np.testing.assert_allclose(grasp.position, arm.fk_tcp(arm.home).position, atol=1e-12)


def test_open_fingers_are_12_35_mm_nearer_to_the_arm(arm: Xarm7) -> None:
    gripper = GripperModel()
    grasp = grasp_pose(arm, gripper, arm.home, gripper.max_width)
    up = grasp.position - arm.fk_tcp(arm.home).position  # the tool points down
    np.testing.assert_allclose(up * 1e3, [0.0, 0.0, 12.35], atol=0.005)


@pytest.mark.parametrize("translation", [np.zeros(3), np.array([0.001, -0.002, 0.003])])
def test_the_arm_makes_up_for_closing_and_turning(arm: Xarm7, translation: np.ndarray) -> None:
    gripper, rotation = GripperModel(), np.array([0.02, 0.01, -0.03])
    before, after = 0.08, 0.03
    tcp = arm.fk_tcp(arm.home)
    moved = tcp_translation(tcp, gripper, translation, rotation, before, after)
    angle = float(np.linalg.norm(rotation))
    half = np.append(np.sin(angle / 2) * rotation / angle, np.cos(angle / 2))
    turned = Pose(np.zeros(3), half).rotation @ tcp.rotation
    grasp_before = tcp.position + gripper.finger_z(before) * tcp.rotation[:, 2]
    grasp_after = tcp.position + moved + gripper.finger_z(after) * turned[:, 2]
    np.testing.assert_allclose(grasp_after - grasp_before, translation, atol=1e-12)
