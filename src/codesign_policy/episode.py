"""What is measured in every control step, and kept until an episode is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_policy.metrics import (
    HOLD_TIME,
    SUCCESS_LIFT,
    GraspMetrics,
    grasp_metrics,
    in_contact,
)
from codesign_policy.reward import RewardComponents, reward_components
from codesign_policy.task import POLICY_PERIOD
from codesign_sim import Simulator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """The object of every lane at the end of a control step.

    Attributes:
        centre: of mass, (E, 3) [m].
        top10_stress, mean_stress, median_stress: co-rotated von Mises stress, (E,) [Pa].
        left_force, right_force: of the fingers on the object, mean over the step, (E, 3) [N].
        penetration: deepest point below a finger's surface, (E,) [m].
        object_speed: of the centre of mass, (E,) [m/s].
        node_speed: of the fastest node, (E,) [m/s].
    """

    centre: Array
    top10_stress: Array
    mean_stress: Array
    median_stress: Array
    left_force: Array
    right_force: Array
    penetration: Array
    object_speed: Array
    node_speed: Array


def measure(simulator: Simulator) -> Measured:
    """Reads the simulator."""
    stress, contact = simulator.stress(), simulator.contact()
    # Without BLAS and in one memory order, or a sum's last bit would depend on how many lanes
    # there are and where they lie.
    weights = (simulator.block.node_volumes / simulator.block.volume)[:, None]
    volumes = simulator.block.volumes / simulator.block.volume
    positions, velocities, von_mises = map(
        np.ascontiguousarray, (simulator.positions, simulator.velocities, stress.von_mises)
    )
    centre = (positions * weights).sum(axis=1)
    drift = (velocities * weights).sum(axis=1)
    return Measured(
        centre=centre,
        top10_stress=stress.top10_mean,
        mean_stress=(von_mises * volumes).sum(axis=1),
        median_stress=stress.median,
        left_force=contact.left,
        right_force=contact.right,
        penetration=contact.finger_penetration,
        object_speed=np.sqrt((drift**2).sum(axis=1)),
        node_speed=np.sqrt((velocities**2).sum(axis=2).max(axis=1)),
    )


class EpisodeLog:
    """The series of one episode per lane, sampled at its start and after every control step.

    Attributes:
        steps: control steps so far, (E,).
        rise: of the object above its place on the table, (E,) [m].
        touching: whether a finger touches the object, (E,).
        steps_up: for how many steps, to now, it was up by `SUCCESS_LIFT` and touched, (E,).
        lost: it was off the table for `LOST_RISE` once and no finger touches it now, (E,).
    """

    LOST_RISE = 0.02  # m

    def __init__(self, count: int, steps: int) -> None:
        """Args: lanes; control steps of the longest episode."""
        self._scalars = np.zeros((steps + 1, count, 3))  # top-10 %, median, height
        self._forces = np.zeros((steps + 1, count, 2, 3))
        self._rest = np.zeros(count)
        self._highest = np.zeros(count)
        self.steps = np.zeros(count, dtype=int)
        self.steps_up = np.zeros(count, dtype=int)
        self.rise = np.zeros(count)
        self.touching = np.zeros(count, dtype=bool)

    def start(self, lanes: NDArray[np.int_], measured: Measured) -> None:
        """Begins the episodes of these lanes."""
        self._rest[lanes] = measured.centre[lanes, 2]
        self._highest[lanes] = 0.0
        self.steps[lanes] = -1
        self.steps_up[lanes] = 0
        self.add(lanes, measured)

    def add(self, lanes: NDArray[np.int_], measured: Measured) -> None:
        """The next sample of these lanes."""
        self.steps[lanes] += 1
        now = self.steps[lanes]
        height = measured.centre[lanes, 2]
        self._scalars[now, lanes, 0] = measured.top10_stress[lanes]
        self._scalars[now, lanes, 1] = measured.median_stress[lanes]
        self._scalars[now, lanes, 2] = height
        self._forces[now, lanes, 0] = left = measured.left_force[lanes]
        self._forces[now, lanes, 1] = right = measured.right_force[lanes]
        self.touching[lanes] = contact = in_contact(left, right)
        self.rise[lanes] = rise = height - self._rest[lanes]
        self._highest[lanes] = np.maximum(self._highest[lanes], rise)
        up = contact & (rise >= SUCCESS_LIFT)
        self.steps_up[lanes] = np.where(up, self.steps_up[lanes] + 1, 0)

    @property
    def lost(self) -> NDArray[np.bool_]:
        return (self._highest > self.LOST_RISE) & ~self.touching

    @property
    def success(self) -> NDArray[np.bool_]:
        """Whether the object is up and has been for `HOLD_TIME`, (E,)."""
        return (self.steps_up - 1) * POLICY_PERIOD >= HOLD_TIME - 1e-9

    def metrics(self, lane: int) -> GraspMetrics:
        """Judges a lane's episode of at least one step as every trial is judged."""
        count = self.steps[lane] + 1
        top10, median, height = self._scalars[:count, lane].T
        left, right = np.moveaxis(self._forces[:count, lane], 1, 0)
        times = np.arange(count) * POLICY_PERIOD
        return grasp_metrics(times, top10, median, left, right, height)


def step_components(
    log: EpisodeLog, measured: Measured, tool_position: Array, opening: Array, rotation: Array
) -> RewardComponents:
    """The reward's components of the control step that ended last; each (E,).

    Args:
        log: has seen the step.
        measured: at its end.
        tool_position: of the grasp frame, (E, 3) [m].
        opening: direction from the right finger to the left one, (E, 3).
        rotation: vector that the hand was told to turn by, (E, 3) [rad].
    """
    away = measured.centre - tool_position
    left = -(measured.left_force * opening).sum(axis=1)
    right = (measured.right_force * opening).sum(axis=1)
    return reward_components(
        rise=log.rise,
        steps_up=log.steps_up,
        normal_force=np.minimum(left, right),
        distance=np.sqrt(away[:, 0] ** 2 + away[:, 1] ** 2),
        top10_stress=measured.top10_stress,
        mean_stress=measured.mean_stress,
        contact=log.touching,
        turned=np.linalg.norm(rotation, axis=1),
    )
