"""The lowest point of a box-shaped finger pair, upright, turned and open."""

import numpy as np
import pytest

from codesign_control import FingerReach, Pose

LEFT = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (0.0, 0.005) for z in (-0.04, 0.006)])
REACH = FingerReach(LEFT, LEFT * [1.0, -1.0, 1.0])
HERE = np.array([0.4, 0.0, 0.1])


def rolled(angle: float, axis: int) -> Pose:
    """Pointing down, then turned about a base axis."""
    down, turn = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4)
    turn[axis], turn[3] = np.sin(angle / 2), np.cos(angle / 2)
    (ax, ay, az, aw), (bx, by, bz, bw) = turn, down
    product = [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]
    return Pose(HERE, np.array(product))


@pytest.mark.parametrize("width", [0.0, 0.03, 0.08])
def test_upright_the_tips_are_lowest_at_any_gap(width: float) -> None:
    assert REACH.lowest(rolled(0.0, 0), width) == pytest.approx(0.1 - 0.006, abs=1e-12)


@pytest.mark.parametrize("angle", [0.2, -0.2])
def test_turned_sideways_an_edge_is_lowest(angle: float) -> None:
    expected = 0.1 - 0.006 * np.cos(angle) - 0.01 * abs(np.sin(angle))
    assert REACH.lowest(rolled(angle, 1), 0.03) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("angle", [0.2, -0.2])
def test_turned_in_the_closing_plane_the_gap_counts(angle: float) -> None:
    outside = 0.03 / 2 + 0.005
    expected = 0.1 - 0.006 * np.cos(angle) - outside * abs(np.sin(angle))
    assert REACH.lowest(rolled(angle, 0), 0.03) == pytest.approx(expected, abs=1e-12)
