"""Finger targets."""

import numpy as np
import pytest

from codesign_sim import FingerTargets
from codesign_sim.fingers import rotation_matrix


def test_from_above_points_down_and_opens_along_y():
    rotation = rotation_matrix(FingerTargets.from_above((0, 0, 0), 0.03).quaternion)[0]
    assert np.allclose(rotation[:, 2], [0, 0, -1])
    assert np.allclose(np.abs(rotation[:, 1]), [0, 1, 0])


def test_yaw_turns_about_the_vertical():
    turned = rotation_matrix(FingerTargets.from_above((0, 0, 0), 0.03, yaw=0.4).quaternion)[0]
    still = rotation_matrix(FingerTargets.from_above((0, 0, 0), 0.03).quaternion)[0]
    about_z = np.array([[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]])
    assert np.allclose(turned, about_z @ still)


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
