"""Where the fingers are: targets, and the path between two of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from codesign_sim.checks import require_finite

_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class FingerTargets:
    """Pose of the grasp frame and opening width, per environment.

    The grasp frame has its origin midway between the fingers at the height of the tool centre
    point, x sideways, y along the opening, z along the approach (downwards in a grasp from
    above). At width w the left finger's mesh is shifted by +w/2 along y, the right one's by -w/2.

    Args:
        position: (E, 3) or (3,) metres, world frame.
        quaternion: (E, 4) or (4,) x, y, z, w of unit length.
        width: (E,) or a number, metres.
    Raises:
        ValueError: wrong shapes, values that are not finite, a quaternion not of unit length.
    """

    position: np.ndarray
    quaternion: np.ndarray
    width: np.ndarray

    def __post_init__(self) -> None:
        position = require_finite(
            "finger position", np.atleast_2d(np.asarray(self.position, float)), (-1, 3), "m"
        )
        quaternion = require_finite(
            "finger quaternion", np.atleast_2d(np.asarray(self.quaternion, float)), (-1, 4)
        )
        width = require_finite(
            "finger width", np.atleast_1d(np.asarray(self.width, float)), (-1,), "m"
        )
        if not len(position) == len(quaternion) == len(width):
            raise ValueError(
                f"finger targets have {len(position)} positions, {len(quaternion)} quaternions "
                f"and {len(width)} widths; give one of each per environment"
            )
        length = np.linalg.norm(quaternion, axis=1)
        worst = float(length[np.argmax(np.abs(length - 1))])
        if abs(worst - 1) > _UNIT_TOLERANCE:
            raise ValueError(
                f"finger quaternion has length {worst:g}, it must be 1 to {_UNIT_TOLERANCE:g}; "
                "normalise it (order x, y, z, w)"
            )
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "quaternion", quaternion / length[:, None])
        object.__setattr__(self, "width", width)

    @classmethod
    def from_above(
        cls, position: np.ndarray | tuple[float, ...], width: float | np.ndarray, yaw: float = 0.0
    ) -> FingerTargets:
        """Fingers pointing down, opening along world y turned by `yaw` (radians)."""
        position = np.atleast_2d(np.asarray(position, dtype=float))
        count = len(position)
        # A half turn about x points z down; yaw turns the result about world z.
        quaternion = np.array([np.cos(yaw / 2), np.sin(yaw / 2), 0.0, 0.0])
        return cls(position, np.tile(quaternion, (count, 1)), np.broadcast_to(width, count))

    def __len__(self) -> int:
        return len(self.width)

    def replaced(self, environments: np.ndarray, targets: FingerTargets) -> FingerTargets:
        """These targets with those of K environments taken from `targets`."""
        position, quaternion = self.position.copy(), self.quaternion.copy()
        width = self.width.copy()
        position[environments] = targets.position
        quaternion[environments] = targets.quaternion
        width[environments] = targets.width
        return FingerTargets(position, quaternion, width)


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) in x, y, z, w order."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return np.stack(entries, axis=-1).reshape(*quaternion.shape[:-1], 3, 3)


def turn_angle(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Angle (E,) in radians between unit quaternions."""
    return 2 * np.arccos(np.clip(np.abs((start * end).sum(axis=-1)), 0, 1))


def motion(start: FingerTargets, end: FingerTargets) -> np.ndarray:
    """The straight, constant-speed motion from start to end, (E, 18), as native/contact.h has it.

    Position (3) and way (3) in metres, first and last quaternion (4 each) the shorter way,
    width and change of width, half the angle between the quaternions and 1 / its sine.
    """
    backwards = (start.quaternion * end.quaternion).sum(axis=-1, keepdims=True) < 0
    last = np.where(backwards, -end.quaternion, end.quaternion)
    # Below a thousandth the weights of the quaternions no longer depend on the angle.
    half = np.maximum(turn_angle(start.quaternion, end.quaternion) / 2, 1e-3)
    values = np.empty((len(start), 18))
    values[:, 0:3], values[:, 3:6] = start.position, end.position - start.position
    values[:, 6:10], values[:, 10:14] = start.quaternion, last
    values[:, 14], values[:, 15] = start.width, end.width - start.width
    values[:, 16], values[:, 17] = half, 1 / np.sin(half)
    return values
