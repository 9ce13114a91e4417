"""xArm7 kinematics, Cartesian servo, limits, gripper and arm model. Pure: no ROS, no clock."""

from codesign_control.arm_model import ArmModel, ArmModelConfig
from codesign_control.config import ServoConfig
from codesign_control.finger_reach import FingerReach
from codesign_control.gripper import G1, G2, GripperModel, GripperMotion, GripperSpec
from codesign_control.hand import Hand
from codesign_control.motion import Limit
from codesign_control.pose import Pose
from codesign_control.servo import (
    ActionRejected,
    CartesianServo,
    GoalState,
    MoveRejected,
    Proximity,
    ServoCounters,
    ServoOutput,
    ServoState,
)
from codesign_control.xarm7 import IkError, Xarm7, urdf

__all__ = [
    "G1",
    "G2",
    "ActionRejected",
    "ArmModel",
    "ArmModelConfig",
    "CartesianServo",
    "FingerReach",
    "GoalState",
    "GripperModel",
    "GripperMotion",
    "GripperSpec",
    "Hand",
    "IkError",
    "Limit",
    "MoveRejected",
    "Pose",
    "Proximity",
    "ServoConfig",
    "ServoCounters",
    "ServoOutput",
    "ServoState",
    "Xarm7",
    "urdf",
]
