"""What the gripper says about the block that it holds: where its centre must be now.

One camera cannot tell how far away a soft block is to better than some millimetres, because the
fingers squeeze it by ten per cent. But once it is gripped it moves with the hand, whose pose the
arm knows to a fraction of a millimetre.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_perception.camera import Floats
from codesign_perception.config import EstimatorConfig
from codesign_perception.tofu_pose import Held, TofuPose, wrapped

SQUEEZE = 0.0003  # m that the gap is narrower than the block before it counts as held
RELEASE = 0.0015  # m that the gap is wider before it counts as let go
REACH = (0.030, 0.012, 0.045)  # m from the grasp frame, along its x, y and z: between the fingers
OLDEST = 300_000_000  # ns that a hand's pose may be older than the picture
KEPT = 100
CARRIED = 0.005  # m that a hand has to rise with the block before it can drop it


@dataclass(frozen=True)
class _Grip:
    block: Floats  # its centre in the grasp frame [m]
    thickness: float  # m, of the free block between the fingers


@dataclass(frozen=True)
class _Sample:
    stamp: int
    position: Floats
    rotation: Rotation


class Hand:
    """Follows the grasp frame and the gap, and says where the block is that they hold.

    Stamps are nanoseconds of the same clock as the pictures'.
    """

    def __init__(self, config: EstimatorConfig) -> None:
        self._size = config.size
        self._samples: deque[_Sample] = deque(maxlen=KEPT)
        self._widths: deque[tuple[int, float]] = deque(maxlen=KEPT)
        self._last: TofuPose | None = None
        self._grip: _Grip | None = None
        self._height = 0.0  # m, of the hand at the last picture
        self._closed_at: float | None = None  # m, its height when the open fingers gripped
        self._dropped = False

    @property
    def holds(self) -> bool:
        """Whether the block counts as gripped."""
        return self._grip is not None

    def reset(self) -> None:
        """Forget everything."""
        self._samples.clear()
        self._widths.clear()
        self._last = self._grip = self._closed_at = None
        self._dropped = False

    def add_pose(self, stamp: int, position: Floats, quaternion: Floats) -> None:
        """The grasp frame in link_base: position (3,) [m], quaternion (4,) x y z w.

        Poses that are not finite or out of order are left out.
        """
        norm = float(np.linalg.norm(quaternion))
        if not (np.isfinite(position).all() and 0.5 < norm < 2.0):
            return
        if self._samples and stamp <= self._samples[-1].stamp:
            if stamp > self._samples[-1].stamp - OLDEST:
                return
            self._samples.clear()  # the clock was set back
        self._samples.append(
            _Sample(stamp, np.array(position, dtype=float), Rotation.from_quat(quaternion))
        )

    def add_width(self, stamp: int, width: float) -> None:
        """The gap between the fingers [m]."""
        if np.isfinite(width):
            self._widths.append((stamp, float(width)))

    def add_block(self, pose: TofuPose) -> None:
        """What the last picture showed.

        A block that is not where the hand holds it was dropped; unless the hand has yet to rise,
        and its lips merely slide under a block that rests: that one it grips anew.
        """
        self._last = pose
        if self._grip is not None and pose.state != "held":
            self._dropped = self._closed_at is None or self._height > self._closed_at + CARRIED
            self._grip = None

    def held(self, stamp: int) -> Held | None:
        """Where the hand has the block at the time of a picture; None if it holds none."""
        sample, width = self._pose_at(stamp), self._width_at(stamp)
        if sample is None or width is None:
            self._grip = None
            return None
        self._height = float(sample.position[2])
        if self._grip is not None and width > self._grip.thickness + RELEASE:
            self._grip = self._closed_at = None
        if self._grip is None and self._last is not None:
            self._try_grip(sample, width)
        if self._grip is None:
            return None
        return Held(sample.position + sample.rotation.apply(self._grip.block))

    def _try_grip(self, sample: _Sample, width: float) -> None:
        """Grips when the gap is narrower than the block between the fingers."""
        assert self._last is not None
        closing = sample.rotation.apply([0.0, 1.0, 0.0])
        turn = abs(wrapped(float(np.arctan2(closing[1], closing[0])) - self._last.yaw))
        thickness = self._size[0] if turn < np.pi / 4.0 else self._size[1]
        if width > thickness - SQUEEZE:
            if width >= thickness + RELEASE:
                self._dropped, self._closed_at = False, None
            return
        local = sample.rotation.inv().apply(self._last.position - sample.position)
        if not self._dropped and (np.abs(local) < REACH).all():
            self._grip = _Grip(local, thickness)
            if self._closed_at is None:
                self._closed_at = self._height

    def _pose_at(self, stamp: int) -> _Sample | None:
        """Between the samples around a moment; the last one before it if it is recent."""
        before = [s for s in self._samples if s.stamp <= stamp]
        if not before or stamp - before[-1].stamp > OLDEST:
            return None
        first = before[-1]
        after = next((s for s in self._samples if s.stamp > stamp), None)
        if after is None or after.stamp - first.stamp > OLDEST:
            return first
        share = (stamp - first.stamp) / (after.stamp - first.stamp)
        position = first.position + share * (after.position - first.position)
        return _Sample(stamp, position, first.rotation)

    def _width_at(self, stamp: int) -> float | None:
        before = [width for at, width in self._widths if stamp - OLDEST <= at <= stamp]
        return before[-1] if before else None
