"""The tool of every lane: lag, limits, turning."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from codesign_design.stock import stock_fingers
from codesign_policy.task import ACTION_SCALE, POLICY_PERIOD, WORKSPACE_LOWER, WORKSPACE_UPPER
from codesign_policy.tool import Tool, ToolStart

FINGERS = stock_fingers()
LAG = 0.08


def tool(count: int = 1, lag: float = LAG, start: ToolStart | None = None) -> Tool:
    made = Tool(count, lag, table_height=0.0)
    for lane in range(count):
        made.set_fingers(lane, FINGERS, narrowest=0.01)
    made.reset(np.arange(count), start or ToolStart())
    return made


def lowest(moved: Tool) -> float:
    """Lowest vertex of any finger where the tools really are [m]."""
    heights = []
    for position, quaternion, width in zip(
        moved.position, moved.quaternion, moved.width, strict=True
    ):
        turn = Rotation.from_quat(quaternion)
        for mesh, side in ((FINGERS.left, 0.5), (FINGERS.right, -0.5)):
            points = turn.apply(mesh.vertices + np.array([0.0, side * width, 0.0])) + position
            heights.append(points[:, 2].min())
    return min(heights)


def test_follows_with_a_first_order_lag() -> None:
    steps = np.array([0.004, 0.007, -0.002, 0.0, 0.0])
    commanded = np.concatenate([[0.0], np.cumsum(steps)])
    times = np.arange(6) * POLICY_PERIOD

    def velocity(t: float, x: np.ndarray) -> np.ndarray:
        return (np.interp(t, times, commanded) - x) / LAG

    exact = solve_ivp(velocity, (0, times[-1]), [0.0], "LSODA", times, rtol=1e-9, atol=1e-12).y[0]
    moved = tool()
    start = moved.position[0, 0]
    for k, step in enumerate(steps):
        moved.move(np.array([[step, 0, 0, 0, 0, 0, 0]]))
        assert moved.position[0, 0] - start == pytest.approx(exact[k + 1], abs=1e-8)


def test_without_a_lag_it_is_where_it_is_told() -> None:
    moved = tool(lag=0.0)
    moved.move(np.array([[0.001, -0.002, 0.003, 0.01, 0.0, 0.0, -0.004]]))
    np.testing.assert_allclose(moved.position[0], np.array([0.451, -0.002, 0.2566]), atol=1e-12)
    assert moved.width[0] == pytest.approx(0.056)


def test_rotations_add_up_about_fixed_axes() -> None:
    moved = tool(lag=0.0)
    turns = np.array([[0.02, 0.0, 0.01], [0.0, -0.025, 0.02], [0.01, 0.01, 0.01]])
    expected = Rotation.from_quat([1, 0, 0, 0])
    for turn in turns:
        moved.move(np.concatenate([np.zeros(3), turn, [0.0]])[None])
        expected = Rotation.from_rotvec(turn) * expected
    assert (Rotation.from_quat(moved.quaternion[0]) * expected.inv()).magnitude() < 1e-12
    np.testing.assert_allclose(moved.opening[0], expected.apply([0.0, 1.0, 0.0]), atol=1e-12)


def test_turns_arrive_with_the_lag_of_translations() -> None:
    moved = tool()
    moved.move(np.array([[0.005, 0, 0, 0, 0, 0.02, 0]]))
    share = (moved.position[0, 0] - 0.45) / 0.005
    turned = Rotation.from_quat(moved.quaternion[0]) * Rotation.from_quat([1, 0, 0, 0]).inv()
    assert turned.as_rotvec()[2] / 0.02 == pytest.approx(share)


def test_lanes_do_not_see_each_other() -> None:
    random = np.random.default_rng(0)
    both, single = tool(2), tool(1)
    for _ in range(20):
        actions = random.uniform(-1, 1, (2, 7)) * ACTION_SCALE
        both.move(actions)
        single.move(actions[1:])
    assert np.array_equal(both.position[1:], single.position)
    assert np.array_equal(both.quaternion[1:], single.quaternion)


@settings(max_examples=15, deadline=None)
@given(st.lists(arrays(np.float64, 7, elements=st.floats(-1, 1)), min_size=1, max_size=5))
def test_stays_in_the_workspace_and_above_the_table(pushes: list[np.ndarray]) -> None:
    moved = tool(start=ToolStart((0.45, 0.0, 0.05)))
    for push in pushes:
        for _ in range(25):
            moved.move((push * ACTION_SCALE)[None])
            assert np.all(moved.position >= WORKSPACE_LOWER - 1e-9)
            assert np.all(moved.position <= WORKSPACE_UPPER + 1e-9)
            assert 0.01 <= moved.width[0] <= FINGERS.max_width
            assert lowest(moved) > -1e-9


def test_the_floor_is_where_the_finger_tips_touch_the_table() -> None:
    moved = tool()
    for _ in range(80):
        moved.move(np.array([[0, 0, -0.007, 0, 0, 0, 0]]))
    assert lowest(moved) == pytest.approx(0.0, abs=1e-6)
    assert moved.position[0, 2] == pytest.approx(FINGERS.tip_depth, abs=1e-6)
