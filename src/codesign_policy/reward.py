"""The reward of the control stage: components in physical terms, and their weights.

The components are what a replay buffer stores; weights can change later (paper, section III-D,
multiplies the stress penalty by 5) and old transitions are relabelled with `weighted`.
"""

from dataclasses import dataclass, fields
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

# Equation 1.
ALPHA = 0.8
BETA = 2000.0  # Pa

STRESS_CAP = 3000.0  # Pa; uncapped, a block crushed by exploration outweighs everything learned
LIFT_GOAL = 0.09  # m, at which the lift component ends growing
FIRM_GRIP = 0.5  # N, at which the contact component ends growing; tofu needs 0.6 N to be held
HELD_STEPS = 3  # control steps up and in contact until the object counts as held

Array = NDArray[np.float64]
Number = TypeVar("Number", float, Array)


@dataclass(frozen=True)
class RewardWeights:
    """Factor of every component of `RewardComponents`.

    Attributes:
        lift: per share of `LIFT_GOAL`.
        held: per step that the object is held up.
        contact: per share of `FIRM_GRIP`.
        distance: per metre.
        stress: per Pa of equation 1.
        turning: per radian. Rotation is not observed (as in the paper), so what is not worth its
            price would add up over the episode.
    """

    lift: float = 1.0
    held: float = 1.0
    contact: float = 0.1
    distance: float = 10.0
    stress: float = 2.5e-4
    turning: float = 20.0


@dataclass(frozen=True)
class RewardComponents:
    """What one control step is judged by; each (E,).

    Attributes:
        lift: rise of the object over `LIFT_GOAL`, 0 to 1.
        held: 1 once the object is up for `HELD_STEPS`, else 0.
        contact: the weaker finger's normal force over `FIRM_GRIP`, 0 to 1.
        distance: minus the horizontal distance of tool and object [m].
        stress: equation 1 while a finger touches the object, else 0 [Pa].
        turning: minus the angle that the hand was told to turn by [rad].
    """

    lift: Array
    held: Array
    contact: Array
    distance: Array
    stress: Array
    turning: Array


def weighted(components: RewardComponents, weights: RewardWeights) -> Array:
    """The reward (E,): the sum of components times weights."""
    total = np.zeros_like(components.lift)
    for field in fields(RewardWeights):
        total += getattr(weights, field.name) * getattr(components, field.name)
    return total


def reward_components(
    rise: Array,
    steps_up: NDArray[np.int_],
    normal_force: Array,
    distance: Array,
    top10_stress: Array,
    mean_stress: Array,
    contact: NDArray[np.bool_],
    turned: Array,
) -> RewardComponents:
    """Components of one control step in E environments, each argument (E,).

    Args:
        rise: of the object's centre above its rest [m].
        steps_up: control steps that the object has been up and in contact, to this one.
        normal_force: of the weaker finger [N].
        distance: horizontal, from tool to object [m].
        top10_stress, mean_stress: [Pa].
        contact: whether a finger touches the object.
        turned: angle that the hand was told to turn by [rad].
    """
    return RewardComponents(
        lift=np.clip(rise / LIFT_GOAL, 0.0, 1.0),
        held=(steps_up >= HELD_STEPS).astype(np.float64),
        contact=np.clip(normal_force / FIRM_GRIP, 0.0, 1.0),
        distance=-distance,
        stress=np.where(contact, stress_penalty(top10_stress, mean_stress), 0.0),
        turning=-turned,
    )


def stress_penalty(top10: Array, mean: Array) -> Array:
    """Equation 1: -(alpha top10 + (1 - alpha) mean)^2 / beta [Pa], stress up to `STRESS_CAP`."""
    stress = np.minimum(ALPHA * top10 + (1.0 - ALPHA) * mean, STRESS_CAP)
    return -(stress**2) / BETA
