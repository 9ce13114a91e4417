"""The simulated cell: arm, gripper and soft block together, without ROS.

Arm and gripper are simulated, too, or real ones: then the fingers follow what those report.
"""

from dataclasses import dataclass

import coal
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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

# Of fingers that follow a real arm. Its controller keeps set-points below 0.5 m/s. Where reports
# jumped, the fingers come after at a speed at which they push the block: at 0.3 m/s they would
# pass through it.
FINGER_SPEED = 0.5  # m/s
JUMP = 0.02  # m; who is further behind
CATCH_UP_SPEED = 0.2  # m/s, goes no faster than this
FINGER_REACH = 0.1  # m, from the grasp frame to the end of any finger
ROOM = 0.005  # m, between fingers and a block that is put down


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
    """Follows joint set-points and gripper commands as a real arm would, and moves the block.

    With a real arm, `stand`, `place_block` and `follow` take the place of `reset` and the commands.
    """

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
        self._followed: tuple[NDArray[np.float64], float] | None = None
        self._park()

    def reset(self, domain: TrialDomain) -> None:
        """Arm to its start posture, gripper open, a new block at rest on the table."""
        self._park()
        self.place_block(domain)

    def place_block(self, domain: TrialDomain) -> None:
        """A new block at rest on the table; arm and gripper stay as they are."""
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
        self._followed = None
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
        if self._followed is None:
            self._arm_model.step(self._command, duration)
            motion = self.gripper.step(self._width_command, duration, self._width_speed)
            self.gripper_velocity = motion.velocity
        else:
            self._move_towards(*self._followed, duration)
        self.simulator.advance(duration, self.finger_targets())

    # --- a real arm

    def stand(self, joints: NDArray[np.float64], width: float) -> None:
        """Puts arm and gripper where real ones are; call `place_block` next.

        Args: as `follow`.

        Raises:
            ValueError: as `follow`.
        """
        self.follow(joints, width)
        self._arm_model.reset(self._followed[0])
        self.gripper.width = self._followed[1]

    def follow(self, joints: NDArray[np.float64], width: float) -> None:
        """Where a real arm and gripper hold the fingers: from the next tick on they go there.

        They go straight in joint space, no faster than `FINGER_SPEED`, and after a jump no faster
        than `CATCH_UP_SPEED`: nothing takes them through the block.

        Args:
            joints: of the arm, (7,) [rad].
            width: gap [m], limited to what the fingers allow.

        Raises:
            ValueError: not 7 finite angles, or a gap that is not finite.
        """
        joints = np.array(joints, dtype=np.float64)
        if joints.shape != (7,) or not np.isfinite(joints).all():
            raise ValueError(f"measured joints {joints}: must be 7 finite angles [rad]")
        self._followed = joints, self.gripper.clip(width)

    def stand_still(self) -> None:
        """The fingers stay where they are until `follow` says where to go."""
        self.follow(self.joint_position, self.gripper.width)

    @property
    def behind(self) -> bool:
        """Whether the fingers are still on their way to where the arm holds them."""
        if self._followed is None:
            return False
        joints, width = self._followed
        return bool((self.joint_position != joints).any() or self.gripper.width != width)

    def _move_towards(self, joints: NDArray[np.float64], width: float, duration: float) -> None:
        before, gap = self.joint_position, self.gripper.width
        old = grasp_pose(self._arm, self.gripper, before, gap)
        new = grasp_pose(self._arm, self.gripper, joints, width)
        turn = Rotation.from_quat(old.quaternion).inv() * Rotation.from_quat(new.quaternion)
        travel = (
            float(np.linalg.norm(new.position - old.position))
            + FINGER_REACH * turn.magnitude()
            + abs(width - gap) / 2.0
        )
        speed = FINGER_SPEED if travel < JUMP else CATCH_UP_SPEED
        share = speed * duration / max(travel, 1e-9)
        if share >= 1.0:
            self._arm_model.reset(joints)
            self.gripper.width = width
        else:
            self._arm_model.reset(before + share * (joints - before))
            self.gripper.width = gap + share * (width - gap)
        self.gripper_velocity = (self.gripper.width - gap) / duration

    def require_room(
        self, domain: TrialDomain, joints: NDArray[np.float64], width: float, fingers: FingerPair
    ) -> None:
        """Whether a block could be put down with the arm there and these fingers on.

        Args:
            domain: where the block is to stand.
            joints, width, fingers: of the arm [rad], the gripper [m].

        Raises:
            ValueError: the fingers are in its place.
        """
        gripper = mounted(fingers, width)
        pose = grasp_pose(self._arm, gripper, joints, gripper.width)
        hand = Rotation.from_quat(pose.quaternion).as_matrix()
        nodes = self.simulator.rest_positions
        block = _Box.around(
            np.vstack([nodes.min(axis=0), nodes.max(axis=0)]) * [1.0, 1.0, 0.0]
            + [[0.0, 0.0, 0.0], [0.0, 0.0, np.ptp(nodes[:, 2])]],
            Rotation.from_euler("z", domain.yaw).as_matrix(),
            np.array([domain.x, domain.y, self.config.table_height]),
        )
        for side, mesh in ((0.5, fingers.left), (-0.5, fingers.right)):
            aside = np.array([0.0, side * gripper.width, 0.0])
            finger = _Box.around(np.asarray(mesh.vertices) + aside, hand, pose.position)
            distance = finger.distance(block)
            if distance < ROOM:
                raise ValueError(
                    f"the fingers are where the block is to stand (at x {domain.x:.3f} m, y "
                    f"{domain.y:.3f} m, the fingers at {np.round(pose.position, 3).tolist()} m): "
                    "move the arm away, then reset again"
                )

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


@dataclass(frozen=True)
class _Box:
    """A box anywhere: sides (3,) [m], rotation (3, 3), centre (3,) [m]."""

    sides: NDArray[np.float64]
    rotation: NDArray[np.float64]
    centre: NDArray[np.float64]

    @staticmethod
    def around(
        points: NDArray[np.float64], rotation: NDArray[np.float64], origin: NDArray[np.float64]
    ) -> "_Box":
        """Around points (n, 3) [m] of a frame with this rotation and origin."""
        low, high = points.min(axis=0), points.max(axis=0)
        return _Box(high - low, rotation, origin + rotation @ (low + high) / 2.0)

    def distance(self, other: "_Box") -> float:
        """Between two boxes, negative where they overlap [m]."""
        shapes = [
            (coal.Box(*box.sides), coal.Transform3s(box.rotation, box.centre))
            for box in (self, other)
        ]
        (one, at), (two, there) = shapes
        return coal.distance(one, at, two, there, coal.DistanceRequest(), coal.DistanceResult())


def _soft_object(config: CellConfig) -> SoftObject:
    if config.object_mesh:
        return TetrahedralMesh.from_file(config.object_mesh, config.object_scale)
    return Block.tofu(config.tetrahedra)
