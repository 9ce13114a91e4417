"""When a block counts as held, and where."""

import numpy as np
import pytest

from codesign_perception.config import EstimatorConfig
from codesign_perception.edges import Colors
from codesign_perception.hand import Hand
from codesign_perception.tofu_pose import TofuPose

DOWN = np.array([1.0, 0.0, 0.0, 0.0])  # the grasp frame looks down, closing along y
TICK = 50_000_000


def block(position, state="resting", yaw=0.0) -> TofuPose:
    colors = Colors(np.full(3, 200.0), np.zeros(3))
    size = np.array([0.05, 0.03, 0.04])
    return TofuPose(
        np.array(position), yaw, size, np.eye(4), 1.0, 0.1, state, np.zeros((6, 2)), colors
    )


def at(hand: Hand, tick: int, position, width: float):
    hand.add_pose(tick * TICK, np.array(position), DOWN)
    hand.add_width(tick * TICK, width)
    return hand.held(tick * TICK)


def test_grips_follows_and_lets_go() -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.451, 0.002, 0.0195]))
    assert at(hand, 0, [0.45, 0.0, 0.01], 0.06) is None
    held = at(hand, 1, [0.45, 0.0, 0.01], 0.0295)
    np.testing.assert_allclose(held.position, [0.451, 0.002, 0.0195], atol=1e-12)
    held = at(hand, 2, [0.46, 0.01, 0.11], 0.0273)
    np.testing.assert_allclose(held.position, [0.461, 0.012, 0.1195], atol=1e-12)
    assert at(hand, 3, [0.46, 0.01, 0.11], 0.032) is None


def test_between_two_poses_of_the_hand() -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02]))
    assert at(hand, 0, [0.45, 0.0, 0.01], 0.028) is not None
    hand.add_pose(TICK, np.array([0.45, 0.0, 0.03]), DOWN)
    held = hand.held(TICK // 4)
    np.testing.assert_allclose(held.position, [0.45, 0.0, 0.025], atol=1e-12)


def test_fingers_that_close_elsewhere_hold_nothing() -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02]))
    assert at(hand, 0, [0.45, 0.03, 0.01], 0.02) is None
    assert at(hand, 1, [0.45, 0.0, 0.12], 0.02) is None


def test_a_turned_block_is_thicker_between_the_fingers() -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02], yaw=np.pi / 2))
    assert at(hand, 0, [0.45, 0.0, 0.01], 0.048) is not None


def test_a_dropped_block_is_not_held_until_the_fingers_open() -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02]))
    assert at(hand, 0, [0.45, 0.0, 0.01], 0.027) is not None
    assert at(hand, 1, [0.45, 0.0, 0.02], 0.027) is not None
    hand.add_block(block([0.45, 0.0, 0.02], "resting"))
    assert at(hand, 2, [0.45, 0.0, 0.02], 0.027) is None
    assert at(hand, 3, [0.45, 0.0, 0.01], 0.06) is None
    assert at(hand, 4, [0.45, 0.0, 0.01], 0.028) is not None


def test_a_block_that_rests_while_lips_slide_under_it_is_gripped_anew() -> None:
    """Between the lips the gap is narrower than the block long before they touch it."""
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02]))
    assert at(hand, 0, [0.45, 0.0, 0.01], 0.028) is not None
    hand.add_block(block([0.45, 0.0, 0.02], "resting"))
    held = at(hand, 1, [0.453, 0.001, 0.012], 0.010)  # the hand moved about the block
    np.testing.assert_allclose(held.position, [0.45, 0.0, 0.02], atol=1e-12)
    held = at(hand, 2, [0.453, 0.001, 0.112], 0.010)
    np.testing.assert_allclose(held.position, [0.45, 0.0, 0.12], atol=1e-12)


def test_a_block_that_stays_while_the_hand_rises_slowly_was_dropped() -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02]))
    heights = (0.010, 0.013, 0.016, 0.019)
    held = []
    for tick, height in enumerate(heights):
        held.append(at(hand, tick, [0.45, 0.0, height], 0.020) is not None)
        hand.add_block(block([0.45, 0.0, 0.02], "resting"))
    assert held == [True, True, True, False]


def test_what_the_hand_said_long_ago_does_not_count() -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02]))
    assert at(hand, 0, [0.45, 0.0, 0.01], 0.027) is not None
    assert hand.held(10 * TICK) is None


@pytest.mark.parametrize("bad", [np.full(3, np.nan), np.array([np.inf, 0.0, 0.0])])
def test_rubbish_is_left_out(bad) -> None:
    hand = Hand(EstimatorConfig())
    hand.add_block(block([0.45, 0.0, 0.02]))
    hand.add_pose(0, bad, DOWN)
    hand.add_pose(1, np.array([0.45, 0.0, 0.01]), np.zeros(4))
    hand.add_width(0, float("nan"))
    hand.add_width(1, 0.027)
    assert hand.held(2) is None
