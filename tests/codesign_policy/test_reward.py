"""Reward components and their weights."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codesign_policy.reward import (
    RewardComponents,
    RewardWeights,
    reward_components,
    stress_penalty,
    weighted,
)

pascals = st.floats(0.0, 1e5)


def components(**changed: object) -> RewardComponents:
    usual = {
        "rise": np.array([0.045]),
        "steps_up": np.array([0]),
        "normal_force": np.array([0.25]),
        "distance": np.array([0.02]),
        "top10_stress": np.array([1000.0]),
        "mean_stress": np.array([500.0]),
        "contact": np.array([True]),
        "turned": np.array([0.01]),
    }
    return reward_components(**{**usual, **changed})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("top10", "mean", "penalty"),
    [
        (2000.0, 2000.0, -2000.0),  # at beta the penalty equals the stress
        (1000.0, 500.0, -(900.0**2) / 2000.0),  # 0.8 * 1000 + 0.2 * 500 = 900
        (1e5, 1e5, -4500.0),  # capped at 3 kPa
    ],
)
def test_stress_penalty_is_equation_1(top10: float, mean: float, penalty: float) -> None:
    assert stress_penalty(np.array([top10]), np.array([mean])) == pytest.approx(penalty)


@given(pascals, pascals, pascals)
def test_more_stress_is_never_better(low: float, high: float, mean: float) -> None:
    low, high = sorted((low, high))
    worse, better = (stress_penalty(np.array([s]), np.array([mean]))[0] for s in (high, low))
    assert -8000.0 <= worse <= better <= 0.0


def test_components_are_shares_and_physical_terms() -> None:
    c = components()
    assert (c.lift[0], c.held[0], c.contact[0]) == pytest.approx((0.5, 0.0, 0.5))
    assert c.distance[0] == -0.02
    assert c.stress[0] == pytest.approx(-405.0)
    assert c.turning[0] == -0.01


def test_components_end_growing() -> None:
    c = components(rise=np.array([0.3, -0.01]), normal_force=np.array([9.0, -1.0]))
    assert c.lift.tolist() == [1.0, 0.0]
    assert c.contact.tolist() == [1.0, 0.0]


def test_held_needs_three_steps_and_stress_counts_in_contact_only() -> None:
    assert components(steps_up=np.array([2, 3])).held.tolist() == [0.0, 1.0]
    assert components(contact=np.array([False])).stress.tolist() == [0.0]


def test_reward_is_the_weighted_sum_and_can_be_relabelled() -> None:
    c = components()
    weights = RewardWeights(lift=2.0, held=3.0, contact=4.0, distance=5.0, stress=1e-3, turning=6.0)
    assert weighted(c, weights)[0] == pytest.approx(1.0 + 0.0 + 2.0 - 0.1 - 0.405 - 0.06)
    heavier = RewardWeights(lift=2.0, held=3.0, contact=4.0, distance=5.0, stress=5e-3, turning=6.0)
    assert weighted(c, heavier)[0] == pytest.approx(weighted(c, weights)[0] - 4 * 0.405)
