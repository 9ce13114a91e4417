"""Observation and action: the layout that training and serving share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codesign_policy.task import (
    ACTION_SCALE,
    ENCODED,
    ControlAction,
    Observation,
    encoded,
    normalised_observations,
    physical_observations,
    scaled_actions,
)

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


def test_a_network_sees_numbers_of_order_one() -> None:
    design = np.array([0.3, -0.7])
    above = Observation(np.array([0.45, 0.1, 0.3]), np.array([0.44, 0.0, 0.02]), 0.06, design)
    expected = [0.0, 1.0, 2.0, -0.1, 0.0, -0.8, 1.0, 1.0, 0.3, -0.7]
    np.testing.assert_allclose(above.normalised(), expected, atol=1e-12)


@given(arrays(np.float64, (3, 11), elements=st.floats(-2.0, 2.0)))
def test_normalised_observations_come_back(vectors: np.ndarray) -> None:
    kept = vectors.copy()
    np.testing.assert_allclose(
        physical_observations(normalised_observations(vectors)), vectors, atol=1e-12
    )
    assert np.array_equal(vectors, kept)
    seen = Observation.from_normalised(normalised_observations(vectors)[1])
    np.testing.assert_allclose(seen.tcp_position, vectors[1, :3], atol=1e-12)
    np.testing.assert_allclose(seen.object_position, vectors[1, 3:6], atol=1e-12)
    assert seen.width == pytest.approx(vectors[1, 6], abs=1e-12)
    np.testing.assert_allclose(seen.design, vectors[1, 8:])


@given(unit)
def test_lanes_scale_actions_as_one_action_is_scaled(action: np.ndarray) -> None:
    one = ControlAction.from_normalised(action)
    row = scaled_actions(np.stack([action, -action]), 2)
    np.testing.assert_allclose(row[0], [*one.translation, *one.rotation, one.width])
    np.testing.assert_allclose(row[1], -row[0])


def test_single_precision_at_the_limit_is_no_error() -> None:
    just_beyond = np.full((1, 7), np.nextafter(np.float32(1.0), np.float32(2.0)))
    np.testing.assert_array_equal(scaled_actions(just_beyond, 1)[0], ACTION_SCALE)
    with pytest.raises(ValueError, match=r"lane 0: dx is 1\.01.*clip it"):
        scaled_actions(np.full((1, 7), 1.01), 1)


def test_the_encoding_sees_a_millimetre() -> None:
    """Moving tool and object together changes their heights alone; far away nothing is new."""
    here = Observation(np.array([0.45, 0.01, 0.05]), np.array([0.44, 0.0, 0.02]), 0.05, np.ones(3))
    first = encoded(here.normalised())
    assert first.shape == (8 + ENCODED + 3,)
    np.testing.assert_allclose(first[:8], here.normalised()[:8], atol=1e-6)
    np.testing.assert_array_equal(first[-3:], 1.0)

    def moved(tool: list[float], thing: list[float], gap: float) -> np.ndarray:
        there = Observation(
            here.tcp_position + tool, here.object_position + thing, here.width + gap, here.design
        )
        return np.abs(encoded(there.normalised())[8:-3] - first[8:-3]).max()

    assert moved([0.1, 0.02, 0.0], [0.1, 0.02, 0.0], 0.0) < 1e-5
    assert moved([0.001, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0) > 0.03
    assert moved([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.001) > 0.03


def test_the_encoding_at_known_places() -> None:
    seen = Observation(np.array([0.45, 0.01, 0.0115]), np.array([0.44, 0.0, 0.0195]), 0.015)
    apart = np.array([0.01, 0.01, -0.008])
    arguments = [*(apart / 0.01), *(apart / 0.03), 0.0115 / 0.03, -0.0005 / 0.02]
    arguments += [0.0, -0.015 / 0.008, -0.030 / 0.008]
    np.testing.assert_allclose(encoded(seen.normalised())[8:], np.tanh(arguments), atol=1e-5)
