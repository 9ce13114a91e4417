"""Where a real arm and gripper were a moment ago, from what they report. Without ROS."""

import math

import numpy as np
from numpy.typing import NDArray

from codesign_control.setpoint_buffer import SetpointBuffer

STALE = 0.2  # s without a report, after which nobody knows where the fingers are


class FollowedArm:
    """Collects reports and reads them a little later, so that their jitter is no motion."""

    def __init__(self) -> None:
        self._joints, self._widths = SetpointBuffer(7), SetpointBuffer(1)
        self._heard = {"/joint_states": -math.inf, "/gripper_state": -math.inf}

    def add_joints(self, moment: float, joints: object, now: float) -> None:
        """A report of the arm, (7,) [rad].

        Args:
            moment: what it says of itself [s]; now: when it came, by the steady clock [s].

        Raises:
            ValueError: not 7 finite angles.
        """
        self._joints.add(moment, np.asarray(joints, dtype=np.float64))
        self._heard["/joint_states"] = now

    def add_width(self, moment: float, width: float, now: float) -> None:
        """A report of the gripper, the gap [m]; times as for `add_joints`.

        Raises:
            ValueError: not finite.
        """
        self._widths.add(moment, np.array([width], dtype=np.float64))
        self._heard["/gripper_state"] = now

    @property
    def heard(self) -> bool:
        """Whether arm and gripper have both reported once."""
        return all(math.isfinite(heard) for heard in self._heard.values())

    def missing(self, now: float) -> str:
        """What has not been heard of for too long, by the steady clock [s]; empty when all is."""
        return ", ".join(
            f"no {topic}" + (f" for {now - heard:.1f} s" if math.isfinite(heard) else " yet")
            for topic, heard in self._heard.items()
            if now - heard > STALE
        )

    def at(self, moment: float) -> tuple[NDArray[np.float64], float]:
        """Joints (7,) [rad] and gap [m] at a moment of the reports, linear in between.

        Only while nothing is missing.
        """
        joints, width = self._joints.at(moment), self._widths.at(moment)
        assert joints is not None
        assert width is not None
        return joints, float(width[0])
