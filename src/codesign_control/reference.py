"""The Cartesian reference: turns action deltas into one smooth moving pose.

A chain of poses, each of which moves a fraction of the way to the one before it in every tick:

    target --linear, over one action period--> spread --lag--> lead --lag--> . --lag--> pose

The target jumps with every action, the spread pose moves at constant velocity through a stream of
equal actions, and the lags round its corners. No stage overshoots: each one is a convex
combination of earlier targets, so what starts and aims inside the workspace box stays inside.

The last two lags are those of the joint motion itself (`JointMotion.follow_velocity`): fed with
the velocity of `lead`, the joints move like `pose`, and feedback is left with little to correct.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from codesign_control.config import ServoConfig
from codesign_control.pose import bounded, difference, displaced

LEAD = 2  # the stage whose velocity is fed forward


class Reference:
    """The moving reference of `link_tcp`. Deltas are (6,): m and rad, in `link_base` axes."""

    def __init__(self, config: ServoConfig, placement: pin.SE3) -> None:
        self._config = config
        self._ticks_per_action = max(1, round(config.action_period / config.period))
        self._lag = 1.0 - np.exp(-config.period / config.smoothing)
        self._lower = np.asarray(config.box_lower) + config.box_margin
        self._upper = np.asarray(config.box_upper) - config.box_margin
        self.anchor(placement)

    def anchor(self, placement: pin.SE3) -> None:
        """Starts again at rest at `placement`: what was left of earlier actions is dropped."""
        self._stages = [placement.copy() for _ in range(LEAD + 3)]
        self._ticks_left = 0

    @property
    def target(self) -> pin.SE3:
        """Where the motion ends when no further action comes."""
        return self._stages[0]

    @property
    def pose(self) -> pin.SE3:
        """Where `link_tcp` should be now."""
        return self._stages[-1]

    def push(self, delta: np.ndarray) -> None:
        """Adds one action to the target and spreads it over the coming action period."""
        config = self._config
        target = displaced(self.target, delta)
        # A start within the margin of the box is not pulled inwards, only kept from going further.
        here = self.target.translation
        lower, upper = np.minimum(self._lower, here), np.maximum(self._upper, here)
        target.translation = np.clip(target.translation, lower, upper)
        # Actions that come faster than they can be carried out do not queue up.
        self._stages[0] = self._within(
            self._stages[1], target, 2 * config.action_translation, 2 * config.action_rotation
        )
        self._ticks_left = self._ticks_per_action

    def advance(self) -> np.ndarray:
        """Moves on by one tick; returns the (6,) displacement to be fed forward."""
        config, stages = self._config, self._stages
        fraction = 1.0 / max(self._ticks_left, 1)
        self._ticks_left = max(self._ticks_left - 1, 0)
        step = bounded(
            difference(stages[1], stages[0]) * fraction,
            config.linear_speed * config.period,
            config.angular_speed * config.period,
        )
        stages[1] = displaced(stages[1], step)
        moved = np.zeros(6)
        for i in range(LEAD, len(stages)):
            step = self._lag * difference(stages[i], stages[i - 1])
            stages[i] = displaced(stages[i], step)
            if i == LEAD:
                moved = step
        return moved

    def drag(self, commanded: pin.SE3) -> None:
        """Brings every stage within a leash of the commanded pose.

        A reference that the arm cannot follow must not run away: an arm at a limit is to turn
        round soon after the actions do.
        """
        config = self._config
        self._stages = [
            self._within(commanded, stage, config.leash, config.leash_rotation)
            for stage in self._stages
        ]

    @staticmethod
    def _within(centre: pin.SE3, pose: pin.SE3, translation: float, rotation: float) -> pin.SE3:
        """`pose`, pulled towards `centre` when it is further away than the two distances."""
        offset = difference(centre, pose)
        near = bounded(offset, translation, rotation)
        return pose if (near == offset).all() else displaced(centre, near)
