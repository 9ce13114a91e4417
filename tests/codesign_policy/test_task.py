"""Observation and action: the layout that training and serving share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codesign_policy.task import ACTION_SCALE, ControlAction, Observation

unit = arrays(np.float64, 7, elements=st.floats(-1.0, 1.0))
anything = arrays(np.float64, 7, elements=st.floats(-1e6, 1e6))


def test_observation_is_laid_out_as_in_the_paper() -> None:
    observation = Observation(
        np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), 0.05, np.array([7.0, 8.0])
    )
    assert observation.vector().tolist() == [1, 2, 3, 4, 5, 6, 0.05, 1, 7, 8]
    assert observation.is_finite()
    assert not Observation(np.full(3, np.nan), np.zeros(3), 0.0).is_finite()
    assert not Observation(np.zeros(3), np.zeros(3), np.inf).is_finite()


@given(unit)
def test_normalised_actions_come_back(action: np.ndarray) -> None:
    physical = ControlAction.from_normalised(action)
    np.testing.assert_allclose(physical.normalised(), action, atol=1e-15)
    assert np.all(np.abs(physical.translation) <= ACTION_SCALE[:3])


@given(anything)
def test_clipping_keeps_the_limits_and_changes_nothing_inside(action: np.ndarray) -> None:
    asked = ControlAction(action[:3], action[3:6], float(action[6]))
    clipped = asked.clipped()
    assert np.abs(clipped.normalised()).max() <= 1.0
    inside = np.abs(asked.normalised()) <= 1.0
    np.testing.assert_allclose(clipped.normalised()[inside], asked.normalised()[inside])


@pytest.mark.parametrize("bad", [np.zeros(6), np.full(7, np.nan), np.full((7, 1), 0.1)])
def test_refuses_what_is_no_action(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="7 finite numbers"):
        ControlAction.from_normalised(bad)
