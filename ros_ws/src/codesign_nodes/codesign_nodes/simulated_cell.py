"""The simulated cell: arm, gripper and soft block together, without ROS."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_control import ArmModel, ArmModelConfig, Xarm7
from codesign_control.grasp_frame import grasp_pose, start_posture
from codesign_design.finger_pair import FingerPair
from codesign_nodes.mounted import mounted
from codesign_policy.domain import TrialDomain
from codesign_policy.simulated_fingers import simulated_fingers
from codesign_sim import (
    Block,
    FingerTargets,
    Material,
    Simulator,
    SoftObject,
    TetrahedralMesh,
)


@dataclass(frozen=True)
class CellConfig:
    """Settings of the cell.

    Attributes:
        tetrahedra: resolution of the block, 600 or 2400.
        object_mesh: file of a tetrahedral mesh to simulate instead of the block, "" for none.
        object_scale: metres per unit of that file.
        table_height: z of the table in link_base [m].
        open_width: gap after a reset [m].
        arm_lag: time constant of each of the two lags with which the arm follows its set-point [s].
        gripper_speed: of the gap where a command states none [m/s].
    """

    tetrahedra: int = 2400
    object_mesh: str = ""
    object_scale: float = 1.0
    table_height: float = 0.0
    open_width: float = 0.060
    arm_lag: float = 0.010
    gripper_speed: float = 0.100


class SimulatedCell:
    """Follows joint set-points and gripper commands as a real arm would, and moves the block."""

    def __init__(self, config: CellConfig, fingers: FingerPair) -> None:
        """Loads the fingers and puts the arm in its start posture; call `reset` for a block."""
        self.config = config
        self.fingers = fingers
        self._arm = Xarm7()
        self.simulator = Simulator(
            _soft_object(config),
            simulated_fingers(fingers),
            table_height=config.table_height,
        )
        self._arm_model = ArmModel(
            self._arm, ArmModelConfig(order=2, time_constant=config.arm_lag), self._arm.home
        )
        self._park()

    def reset(self, domain: TrialDomain) -> None:
        """Arm to its start posture, gripper open, a new block at rest on the table."""
        self._park()
        self.simulator.reset(
            Material(
                young_modulus=domain.young_modulus,
                poisson_ratio=domain.poisson_ratio,
                density=domain.density,
                friction=domain.friction,
            ),
            position=(domain.x, domain.y),
            yaw=domain.yaw,
            fingers=self.finger_targets(),
        )

    def _park(self) -> None:
        """Arm in its start posture, gripper open, nothing asked of them."""
        self.gripper = mounted(self.fingers, self.config.open_width)
        self.gripper_velocity = 0.0
        self._command = start_posture(self._arm, self.gripper, self.gripper.width)
        self._arm_model.reset(self._command)
        self._width_command, self._width_speed = self.gripper.width, self.config.gripper_speed

    def set_fingers(self, fingers: FingerPair) -> None:
        """Swaps the fingers; call `reset` next: the block has no place between them yet.

        Raises:
            ValueError: meshes that the simulator cannot use, or no room to open; the old fingers
                stay.
        """
        self.check_fingers(fingers)
        self.simulator.set_fingers(*simulated_fingers(fingers))
        self.fingers = fingers
        self._park()

    @staticmethod
    def check_fingers(fingers: FingerPair) -> None:
        """Whether `set_fingers` would take them.

        Raises:
            ValueError: meshes that the simulator cannot use, or no room to open.
        """
        simulated_fingers(fingers)
        mounted(fingers)

    def command_joints(self, position: NDArray[np.float64]) -> None:
        """New set-point of the arm, (7,) [rad].

        Raises:
            ValueError: not 7 finite numbers.
        """
        position = np.asarray(position, dtype=np.float64)
        if position.shape != (7,) or not np.isfinite(position).all():
            raise ValueError(f"joint command {position}: must be 7 finite angles [rad]")
        self._command = position

    def command_width(self, width: float, speed: float = 0.0) -> None:
        """New target gap [m], limited to what the fingers allow; speed 0: the default [m/s].

        Raises:
            ValueError: not finite, or a negative speed.
        """
        if not np.isfinite([width, speed]).all() or speed < 0.0:
            raise ValueError(f"gripper command {width} m at {speed} m/s: must be finite")
        self._width_command = self.gripper.clip(width)
        self._width_speed = speed or self.config.gripper_speed

    def tick(self, duration: float) -> None:
        """Moves arm, gripper and block on by `duration` [s]."""
        self._arm_model.step(self._command, duration)
        motion = self.gripper.step(self._width_command, duration, self._width_speed)
        self.gripper_velocity = motion.velocity
        self.simulator.advance(duration, self.finger_targets())

    @property
    def joint_position(self) -> NDArray[np.float64]:
        """(7,) [rad]."""
        return self._arm_model.position

    @property
    def joint_velocity(self) -> NDArray[np.float64]:
        """(7,) [rad/s]."""
        return self._arm_model.velocity

    @property
    def width_command(self) -> float:
        """The gap last asked for [m]."""
        return self._width_command

    def grasp_pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Grasp frame in link_base: position (3,) [m], quaternion (4,) x y z w."""
        pose = grasp_pose(self._arm, self.gripper, self.joint_position, self.gripper.width)
        return pose.position, pose.quaternion

    def finger_targets(self) -> FingerTargets:
        """Where arm and gripper hold the fingers now."""
        position, quaternion = self.grasp_pose()
        return FingerTargets(
            position=position[None],
            quaternion=quaternion[None],
            width=np.array([self.gripper.width]),
        )


def _soft_object(config: CellConfig) -> SoftObject:
    if config.object_mesh:
        return TetrahedralMesh.from_file(config.object_mesh, config.object_scale)
    return Block.tofu(config.tetrahedra)
