"""Poses: the value that crosses the library's border, and the few operations the servo needs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin


@dataclass(frozen=True)
class Pose:
    """Where a frame is in `link_base`.

    position: (3,) m. quaternion: (4,) x, y, z, w; normalised on construction.
    Raises ValueError when a value is not finite, has the wrong length or the quaternion is zero.
    """

    position: np.ndarray
    quaternion: np.ndarray

    def __post_init__(self) -> None:
        position = finite_vector("position", self.position, 3)
        quaternion = finite_vector("quaternion", self.quaternion, 4)
        norm = float(np.linalg.norm(quaternion))
        if norm < 1e-6:
            raise ValueError("quaternion: all zero")
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "quaternion", quaternion / norm)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) rotation matrix, `link_base` from the frame."""
        return pin.Quaternion(self.quaternion).toRotationMatrix()

    @property
    def matrix(self) -> np.ndarray:
        """(4, 4) homogeneous transform, `link_base` from the frame."""
        return self.to_se3().homogeneous

    def to_se3(self) -> pin.SE3:
        return pin.SE3(self.rotation, self.position)

    @staticmethod
    def from_se3(placement: pin.SE3) -> Pose:
        quaternion = pin.Quaternion(placement.rotation).coeffs()
        # q and -q are one rotation: w >= 0 makes equal poses equal numbers.
        return Pose(placement.translation.copy(), quaternion if quaternion[3] >= 0 else -quaternion)


def finite_vector(name: str, value: object, length: int) -> np.ndarray:
    """`value` as a new (length,) float array; ValueError naming it when it is not one."""
    try:
        vector = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: not a list of numbers") from error
    if vector.shape != (length,):
        raise ValueError(f"{name}: shape {vector.shape}, expected ({length},)")
    if not np.isfinite(vector).all():
        raise ValueError(f"{name}: not finite: {vector.tolist()}")
    return vector


def difference(start: pin.SE3, end: pin.SE3) -> np.ndarray:
    """(6,) translation [m] and rotation vector [rad], in base axes, that take `start` to `end`."""
    rotation = pin.log3(end.rotation @ start.rotation.T)
    return np.concatenate([end.translation - start.translation, rotation])


def displaced(start: pin.SE3, delta: np.ndarray) -> pin.SE3:
    """`start` moved by a (6,) translation [m] and rotation vector [rad], both in base axes."""
    return pin.SE3(pin.exp3(delta[3:]) @ start.rotation, start.translation + delta[:3])


def bounded(delta: np.ndarray, translation: float, rotation: float) -> np.ndarray:
    """(6,) `delta` with its two parts shortened to at most `translation` m and `rotation` rad."""
    moved, turned = math.hypot(*delta[:3]), math.hypot(*delta[3:])
    result = delta.copy()
    if moved > translation:
        result[:3] *= translation / moved
    if turned > rotation:
        result[3:] *= rotation / turned
    return result
