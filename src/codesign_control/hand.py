"""The hand: a gripper and the real shape of its fingers, wherever they are."""

from __future__ import annotations

import numpy as np

from codesign_control.finger_reach import FingerReach
from codesign_control.gripper import GripperModel

TCP_FROM_FLANGE = 0.172  # m, along z: the gripper's TCP
# Without a finger design: as large as the stock fingers, which are 32 x 7 x 46 mm.
STOCK_BOX = np.array([[-0.016, 0.0, -0.0406], [0.016, 0.007, 0.0055]])  # m, grasp frame at gap 0
SWEEP = 61  # gaps that stand for all of them


class Hand:
    """Where the surface of both fingers is, at any gap.

    gripper: the four-bar with these fingers. fingers: their corners in the grasp frame at gap 0;
    boxes of the stock fingers' size when None.
    """

    def __init__(
        self, gripper: GripperModel | None = None, fingers: FingerReach | None = None
    ) -> None:
        self.gripper = gripper or GripperModel()
        self.fingers = fingers or _stock_boxes()

    @property
    def width_range(self) -> tuple[float, float]:
        """Smallest and largest gap [m]."""
        return self.gripper.min_width, self.gripper.max_width

    def corners(self, width: float) -> np.ndarray:
        """(N, 3) m: corners of the fingers' convex hulls in `link_tcp`, at a gap [m]."""
        width = self.gripper.clip(width)
        left, right = self.fingers.corners
        aside = np.array([0.0, width / 2, 0.0])
        forward = np.array([0.0, 0.0, self.gripper.finger_z(width)])
        return np.concatenate([left + aside, right - aside]) + forward

    def swept_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner (3,) [m] in `link_tcp` of all places where a finger can be."""
        # Between the samples, 1.4 mm apart, the four-bar's arc rises by less than 5 um.
        widths = np.linspace(*self.width_range, SWEEP)
        places = np.concatenate([self.corners(width) for width in widths])
        return places.min(axis=0) - 5e-6, places.max(axis=0) + 5e-6


def _stock_boxes() -> FingerReach:
    corners = np.stack(np.meshgrid(*STOCK_BOX.T, indexing="ij"), axis=-1).reshape(-1, 3)
    return FingerReach(corners, corners * [1.0, -1.0, 1.0])
