"""The tool of every lane: where it is told to be, and where arm and gripper have followed."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from codesign_design.finger_pair import FingerPair
from codesign_policy.task import POLICY_PERIOD, WORKSPACE_LOWER, WORKSPACE_UPPER
from codesign_sim.fingers import FingerTargets, rotation_matrix

Array = NDArray[np.float64]

DOWN = np.array([1.0, 0.0, 0.0, 0.0])  # quaternion x, y, z, w of a grasp from above
_SIDES = np.array([0.5, -0.5])  # of the gap, left and right along y


@dataclass(frozen=True)
class ToolStart:
    """Where the tool is when an episode starts, pointing down.

    Attributes:
        position: of the grasp frame in link_base [m]; by default that of the arm's start posture.
        width: gap [m].
    """

    position: tuple[float, float, float] = (0.45, 0.0, 0.2536)
    width: float = 0.060


class Tool:
    """Grasp frames and gaps of E lanes that follow increments.

    An action moves the commanded pose, evenly over the control step, and the tool follows it with
    a first-order lag, solved exactly for that motion. The gap follows without one. The command
    stays inside the workspace, with the fingers above the table.

    Attributes:
        position, quaternion, width: where the tools are, (E, 3) [m], (E, 4) x y z w, (E,) [m].
    """

    def __init__(self, count: int, lag: float, table_height: float) -> None:
        """Args: number of lanes; time constant [s], 0 for none; z of the table [m]."""
        self._decay = float(np.exp(-POLICY_PERIOD / lag)) if lag > 0.0 else 0.0
        self._trail = lag / POLICY_PERIOD * (1.0 - self._decay)  # of a step, behind at its end
        self._table_height = table_height
        self._command, self._turn = np.zeros((count, 3)), np.tile(DOWN, (count, 1))
        self._ahead = np.zeros((count, 6))  # tool from command: m, and rotation vector
        self._hulls = [np.zeros((2, 1, 3))] * count
        self._hull = np.zeros((count, 2, 1, 3))
        self._gaps = np.zeros((count, 2))
        self.position, self.quaternion = self._command.copy(), self._turn.copy()
        self.width = np.zeros(count)

    def set_fingers(self, lane: int, fingers: FingerPair, narrowest: float = 0.0) -> None:
        """The fingers of a lane, which limit its gap and how low it may go.

        Args:
            lane: its index.
            fingers: the pair.
            narrowest: smallest gap that can be commanded, whatever the fingers allow [m].
        """
        left, right = (
            mesh.vertices[ConvexHull(mesh.vertices).vertices]
            for mesh in (fingers.left, fingers.right)
        )
        most = max(len(left), len(right))
        self._hulls[lane] = np.stack([_repeated(left, most), _repeated(right, most)])
        most = max(hull.shape[1] for hull in self._hulls)
        self._hull = np.stack([[_repeated(side, most) for side in hull] for hull in self._hulls])
        self._gaps[lane] = max(fingers.min_width, narrowest), fingers.max_width

    def reset(self, lanes: NDArray[np.int_], start: ToolStart) -> None:
        """Puts tools at their start, standing still."""
        self._command[lanes] = self.position[lanes] = start.position
        self._turn[lanes] = self.quaternion[lanes] = DOWN
        self._ahead[lanes] = 0.0
        self.width[lanes] = np.clip(start.width, *self._gaps[lanes].T)

    def move(self, increments: Array) -> None:
        """Carries out one action each over one control step.

        Args:
            increments: (E, 7): translation [m] and rotation vector [rad] in link_base, gap [m].
        """
        self.width = np.clip(self.width + increments[:, 6], *self._gaps.T)
        self._turn = _turned(increments[:, 3:6], self._turn)
        command = np.clip(self._command + increments[:, :3], WORKSPACE_LOWER, WORKSPACE_UPPER)
        self._lift_off_the_table(command, self._turn)
        step = np.concatenate([command - self._command, increments[:, 3:6]], axis=1)
        self._command = command
        self._ahead = self._decay * self._ahead - self._trail * step
        self.position = command + self._ahead[:, :3]
        self.quaternion = _turned(self._ahead[:, 3:], self._turn)
        # A turn that lags behind its command may need more room than either end of it.
        self._lift_off_the_table(self.position, self.quaternion)

    def targets(self, lanes: NDArray[np.int_] | None = None) -> FingerTargets:
        """Where the fingers of these lanes are to be; None for all."""
        chosen = np.arange(len(self.width)) if lanes is None else lanes
        return FingerTargets(self.position[chosen], self.quaternion[chosen], self.width[chosen])

    @property
    def opening(self) -> Array:
        """Direction from the right finger to the left one, (E, 3)."""
        return rotation_matrix(self.quaternion)[:, :, 1]

    def _lift_off_the_table(self, position: Array, quaternion: Array) -> None:
        """Raises positions (E, 3) of the grasp frame until the fingers' lowest points are clear."""
        row = rotation_matrix(quaternion)[:, 2]
        height = (self._hull @ row[:, None, :, None])[..., 0].min(axis=2)
        lowest = (height + _SIDES * (self.width * row[:, 1])[:, None]).min(axis=1)
        position[:, 2] = np.maximum(position[:, 2], self._table_height - lowest)


def _repeated(points: Array, count: int) -> Array:
    """Points (V, 3) with the last one repeated, (count, 3)."""
    return np.concatenate([points, np.repeat(points[-1:], count - len(points), axis=0)])


def _turned(vector: Array, quaternion: Array) -> Array:
    """Quaternions (E, 4) turned by rotation vectors (E, 3) about the fixed axes."""
    half = np.sqrt((vector * vector).sum(axis=1)) / 2.0
    a, b, c = np.sinc(half / np.pi) / 2.0 * vector.T  # sinc: sin(half) / half, also at 0
    d = np.cos(half)
    x, y, z, w = quaternion.T
    turned = np.stack(
        [
            d * x + a * w + b * z - c * y,
            d * y + b * w + c * x - a * z,
            d * z + c * w + a * y - b * x,
            d * w - a * x - b * y - c * z,
        ],
        axis=1,
    )
    return turned / np.sqrt((turned * turned).sum(axis=1, keepdims=True))
