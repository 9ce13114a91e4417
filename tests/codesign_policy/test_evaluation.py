"""Intervals with known answers, and an evaluation of fingers that do nothing."""

import numpy as np
import pytest
from random_pair import random_pair

from codesign_policy.control_env import ControlConfig
from codesign_policy.evaluation import evaluate, mean_interval


def test_the_interval_of_a_mean() -> None:
    """Of 400 normal numbers: mean +- 1.96 / 20, to a tenth of its length."""
    values = 10.0 + np.random.default_rng(1).normal(size=400)
    found = mean_interval(values)
    assert found is not None
    low, high = found
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20.0, rel=0.1)
    assert low < values.mean() < high


def test_one_value_has_no_interval() -> None:
    assert mean_interval(np.array([3.0])) is None
    assert mean_interval(np.full(5, 3.0)) is None


def test_a_pair_that_does_not_grasp() -> None:
    found = evaluate(random_pair(), 8, ControlConfig(), seed=3)
    assert found.episodes == 8
    assert found.success_rate == 0.0
    assert found.success_interval[0] == 0.0
    # Clopper and Pearson: 1 - 0.025^(1/8)
    assert found.success_interval[1] == pytest.approx(1.0 - 0.025 ** (1 / 8), rel=1e-6)
    assert found.score == 0.0


def test_one_episode_is_too_few() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        evaluate(random_pair(), 1, ControlConfig())
