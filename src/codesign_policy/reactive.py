"""The expert that demonstrations show: a grasp that acts on what it sees alone.

The scripted grasp (`scripted.py`) follows a clock: where it stands still, the same observation is
answered by nothing at first and by a lift later, and a network that sees no clock can only learn to
stand still. Here every action follows from the observation, without a place to stand still before
the object is up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair
from codesign_policy.domain import BLOCK_SIZE
from codesign_policy.scripted import GraspPlan
from codesign_policy.task import (
    MAX_TRANSLATION,
    MAX_WIDTH_CHANGE,
    POLICY_PERIOD,
    ControlAction,
    Observation,
)

GAIN = 0.25  # of an error, per policy period; arm and gripper lag by about one
PRESS = (
    0.004  # m below the grasp's height that the hand aims at: what stops it is the table's limit
)
LOW = (0.001, 0.003)  # m above the grasp's height: closing at full speed below, not at all above
SHUT = (0.0005, 0.0025)  # m of gap left: lifting at full speed below, not at all above
BEFORE_GRIP = (0.034, 0.038)  # m of gap: below the block may be touched, it is not followed
ALIGNED = (0.002, 0.005)  # m from the block's middle, or of gap left to open: descending below that
RAISED = 0.003  # m of the object's rise that tells that it is held
LIFT_STEP = 0.004  # m per policy period


@dataclass(frozen=True)
class ReactiveGrasp:
    """Closes to the plan's gap on the table, then lifts; a function of the observation.

    Attributes:
        plan: gaps, speed of closing, hover and lift.
        table_height: in link_base [m].
        tip_depth: reach of the tips beyond the tool centre point [m].
    """

    plan: GraspPlan
    table_height: float
    tip_depth: float

    def act(self, seen: Observation) -> ControlAction:
        """The action that answers an observation."""
        above = seen.tcp_position[2] - self.table_height - self.plan.clearance - self.tip_depth
        left = seen.width - self.plan.width
        rise = seen.object_position[2] - self.table_height - BLOCK_SIZE[2] / 2.0
        lifting = 1.0 if rise > RAISED else _below(left, SHUT)
        closing = max(_below(above, LOW), lifting)
        offset = seen.object_position[:2] - seen.tcp_position[:2]
        aside = GAIN * offset * (1.0 - _below(seen.width, BEFORE_GRIP))
        return ControlAction(
            np.append(aside, self._up(above, lifting, offset, seen.width)),
            np.zeros(3),
            self._gap(seen.width, closing),
        ).clipped()

    def _up(self, above: float, lifting: float, offset: NDArray[np.float64], width: float) -> float:
        """Along z [m]."""
        down = np.clip(GAIN * (above + PRESS), 0.0, MAX_TRANSLATION[2])
        if above > self.plan.hover:
            ready = 1.0
        else:  # near the block only above it and open, or about to close
            open_enough = _below(self.plan.open_width - width, ALIGNED)
            ready = max(_below(above, LOW), open_enough * _below(np.linalg.norm(offset), ALIGNED))
        up = np.clip(GAIN * (self.plan.lift - above), -LIFT_STEP, LIFT_STEP)
        return float(lifting * up - (1.0 - lifting) * ready * down)

    def _gap(self, width: float, closing: float) -> float:
        """Change of the gap [m]."""
        close_step = self.plan.close_speed * POLICY_PERIOD
        shut = np.clip(GAIN * (self.plan.width - width), -close_step, close_step)
        opened = np.clip(GAIN * (self.plan.open_width - width), -MAX_WIDTH_CHANGE, MAX_WIDTH_CHANGE)
        return float(closing * shut + (1.0 - closing) * opened)


def _below(value: float | np.floating, limits: tuple[float, float]) -> float:
    """1 below the first limit, 0 above the second, straight between them."""
    low, high = limits
    return float(np.clip((high - value) / (high - low), 0.0, 1.0))


class ReactiveLanes:
    """The reactive grasp in every lane. The table is at height 0."""

    def __init__(self, fingers: Sequence[FingerPair], plans: Sequence[GraspPlan]) -> None:
        """Args: fingers and settings of the grasp of every lane."""
        self._experts = [
            ReactiveGrasp(plan, 0.0, pair.tip_depth)
            for pair, plan in zip(fingers, plans, strict=True)
        ]

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Each lane's next action."""
        actions = [
            expert.act(Observation.from_normalised(seen)).normalised()
            for expert, seen in zip(self._experts, observations, strict=True)
        ]
        return np.array(actions, np.float32)
