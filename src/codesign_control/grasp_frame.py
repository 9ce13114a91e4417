"""The grasp frame: `link_tcp`, carried along tool z by the gripper's four-bar.

While the gripper closes its fingers also move along z. Observations and actions speak of the
grasp frame, which stays between the fingers; the arm makes up for the difference.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from codesign_control.gripper import GripperModel
from codesign_control.pose import Pose
from codesign_control.xarm7 import Xarm7


def grasp_pose(arm: Xarm7, gripper: GripperModel, q: np.ndarray, width: float) -> Pose:
    """The grasp frame in `link_base` at joints (7,) [rad] and gap [m]."""
    tcp = arm.tcp_placement(q)
    return Pose.from_se3(tcp * _shift(gripper.finger_z(gripper.clip(width))))


def start_posture(arm: Xarm7, gripper: GripperModel, width: float) -> np.ndarray:
    """Joints (7,) [rad] near `arm.home` that hold the grasp frame at a gap [m] where the stock
    fingers have it at home: the drive joint differs, and with it the four-bar's shift.
    """
    tcp = arm.tcp_placement(arm.home)
    deeper = GripperModel().finger_z(width) - gripper.finger_z(gripper.clip(width))
    if abs(deeper) < 1e-9:
        return arm.home.copy()
    return arm.ik(Pose.from_se3(tcp * _shift(deeper)), arm.home)


def displaced_grasp(
    tcp: Pose, gripper: GripperModel, translation: np.ndarray, rotation: np.ndarray, width: float
) -> Pose:
    """Where the grasp frame of `link_tcp` at `tcp` and a gap [m] is after a displacement.

    translation, rotation: in base axes, (3,) [m] and (3,) rotation vector [rad].
    """
    grasp = tcp.to_se3() * _shift(gripper.finger_z(gripper.clip(width)))
    moved = pin.SE3(pin.exp3(rotation) @ grasp.rotation, grasp.translation + translation)
    return Pose.from_se3(moved)


def tcp_translation(
    tcp: Pose,
    gripper: GripperModel,
    translation: np.ndarray,
    rotation: np.ndarray,
    width_before: float,
    width_after: float,
) -> np.ndarray:
    """How far `link_tcp` has to move, (3,) [m], for a displacement of the grasp frame.

    tcp: where `link_tcp` is going to be when the displacement starts.
    translation, rotation: of the grasp frame in base axes, (3,) [m] and (3,) rotation vector [rad].
    width_before, width_after: gap over the same time [m].
    """
    moved = displaced_grasp(tcp, gripper, translation, rotation, width_before).to_se3()
    end = moved * _shift(gripper.finger_z(gripper.clip(width_after))).inverse()
    return np.asarray(end.translation - tcp.position)


def _shift(z: float) -> pin.SE3:
    return pin.SE3(np.eye(3), np.array([0.0, 0.0, z]))
