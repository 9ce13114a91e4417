"""The gripper with a pair of fingers mounted, for the simulated arm and the controller alike."""

from codesign_control import GripperModel
from codesign_design.finger_pair import FingerPair


def mounted(fingers: FingerPair, width: float | None = None) -> GripperModel:
    """The gripper with these fingers at a gap [m], or fully open.

    Raises:
        ValueError: the fingers are too deep to open, or their limits leave no room.
    """
    limits = (fingers.min_width, fingers.max_width)
    return GripperModel(fingers.protrusion, width=width, limits=limits)
