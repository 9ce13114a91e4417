"""Finger poses and the path between them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_sim import FingerTargets
from codesign_sim.fingers import path, rotation_matrix


def test_from_above_points_down_and_opens_along_y():
    rotation = rotation_matrix(FingerTargets.from_above((0, 0, 0), 0.03).quaternion)[0]
    assert np.allclose(rotation[:, 2], [0, 0, -1])
    assert np.allclose(np.abs(rotation[:, 1]), [0, 1, 0])


def test_yaw_turns_about_the_vertical():
    turned = rotation_matrix(FingerTargets.from_above((0, 0, 0), 0.03, yaw=0.4).quaternion)[0]
    still = rotation_matrix(FingerTargets.from_above((0, 0, 0), 0.03).quaternion)[0]
    about_z = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    assert np.allclose(turned, about_z @ still)


def test_width_shifts_the_fingers_apart_along_their_opening():
    target = FingerTargets(np.array([1.0, 2.0, 3.0]), np.array([0, 0, 0, 1.0]), 0.04)
    left, right = path(target, target, np.array([0.0]))[0, 0, :, 9:]
    assert np.allclose(left, [1.0, 2.02, 3.0])
    assert np.allclose(right, [1.0, 1.98, 3.0])


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.floats(0, 1))
def test_path_moves_and_turns_at_constant_speed(seed, share):
    rng = np.random.default_rng(seed)
    quaternions = rng.standard_normal((2, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    start = FingerTargets(rng.standard_normal(3), quaternions[0], rng.uniform(0, 0.05))
    end = FingerTargets(rng.standard_normal(3), quaternions[1], rng.uniform(0, 0.05))
    first, between, last = path(start, end, np.array([0.0, share, 1.0]))[:, 0]
    middle = between[:, 9:].mean(axis=0)
    expected = (1 - share) * start.position[0] + share * end.position[0]
    assert np.allclose(middle, expected)
    whole, part = _angle(first, last), _angle(first, between)
    assert part == pytest.approx(share * whole, abs=1e-6)


def _angle(a, b):
    relative = a[0, :9].reshape(3, 3).T @ b[0, :9].reshape(3, 3)
    skew = [relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0]]
    skew.append(relative[1, 0] - relative[0, 1])
    return np.arctan2(np.linalg.norm(skew), np.trace(relative) - 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((np.nan, 0, 0), (0, 0, 0, 1), 0.03), "finger position contains nan"),
        (((0, 0, 0), (0, 0, 0, 1), np.inf), "finger width contains inf"),
        (((0, 0, 0), (0, 0, 0, 2), 0.03), "quaternion has length 2, it must be 1"),
        (((0, 0, 0), (0, 0, 1), 0.03), r"finger quaternion has shape \(1, 3\)"),
        (((0, 0, 0), (0, 0, 0, 1), (0.03, 0.02)), "1 positions, 1 quaternions and 2 widths"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        FingerTargets(*arguments)
