"""The expert that acts on what it sees: on a hand that follows late, and on tofu."""

from dataclasses import replace

import numpy as np
import pytest

from codesign_design.stock import stock_fingers
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.expert_plan import DemonstrationError, best_plan
from codesign_policy.finger_plan import plan_for
from codesign_policy.reactive import LIFT_STEP, ReactiveGrasp, ReactiveLanes
from codesign_policy.rollout import roll_out
from codesign_policy.task import ControlAction, Observation

OBJECT = np.array([0.453, -0.003, 0.0195])
PLAN = plan_for(stock_fingers())
TIP = 0.0054
EXPERT = ReactiveGrasp(PLAN, 0.0, TIP)
GRASP = PLAN.clearance + TIP  # m, height of the tool centre point while it closes


def answer(position: list[float], width: float, centre: np.ndarray = OBJECT) -> ControlAction:
    return EXPERT.act(Observation(np.array(position), centre, width))


def run(start: list[float], width: float, lag: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """States (T, 4) of a hand that makes up a share of what is missing each period, and heights of
    an object that goes with the hand while the gap is closed."""
    command = np.array([*start, width])
    state, centre = command.copy(), OBJECT.copy()
    states, heights = [], []
    for _ in range(200):
        action = EXPERT.act(Observation(state[:3], centre, float(state[3])))
        command = command + np.append(action.translation, action.width)
        command[2] = max(command[2], GRASP)  # the table's limit
        before = state.copy()
        state = state + (1.0 - lag) * (command - state)
        if state[3] < PLAN.width + 0.002:
            centre = centre + (state - before)[:3]
        states.append(state.copy())
        heights.append(centre[2])
    return np.array(states), np.array(heights)


@pytest.mark.parametrize("start", [[0.45, 0.0, 0.25], [0.47, 0.02, 0.12], [0.44, -0.02, 0.30]])
def test_it_lifts_once_it_has_closed(start: list[float]) -> None:
    states, heights = run(start, 0.06)
    assert heights[-1] - OBJECT[2] == pytest.approx(PLAN.lift, abs=0.003)
    assert states[-1, 3] == pytest.approx(PLAN.width, abs=2e-4)
    assert np.abs(states[-1, :2] - OBJECT[:2]).max() < 0.002
    first = int(np.argmax(heights > OBJECT[2] + 0.001))
    assert states[first, 3] < PLAN.width + 0.0025


def test_it_never_stands_still_before_the_object_is_up() -> None:
    """A network that learns from it sees no clock."""
    states, heights = run([0.45, 0.0, 0.25], 0.06)
    up = int(np.argmax(heights > OBJECT[2] + 0.9 * PLAN.lift))
    steps = np.abs(np.diff(states[:up], axis=0)).max(axis=1)
    assert steps.min() > 1e-4


def test_equal_observations_get_equal_answers() -> None:
    lanes = ReactiveLanes([stock_fingers()] * 2, [PLAN, PLAN])
    seen = Observation(np.array([0.45, 0.0, 0.1]), OBJECT, 0.05).normalised().astype(np.float32)
    first = lanes.act(np.array([seen, seen]))
    assert np.array_equal(first[0], first[1])
    assert np.array_equal(lanes.act(np.array([seen, seen])), first)
    assert first.dtype == np.float32


def test_off_the_middle_it_waits_above_the_block() -> None:
    aside = answer([0.43, -0.003, GRASP + PLAN.hover - 0.005], PLAN.open_width)
    assert aside.translation[2] == 0.0
    assert aside.translation[0] > 0.003
    assert answer([0.453, -0.003, GRASP + 0.02], PLAN.open_width).translation[2] < -0.004


def test_what_is_held_is_lifted_and_not_followed() -> None:
    raised = OBJECT + np.array([0.004, 0.0, 0.05])
    action = answer([0.453, -0.003, GRASP + 0.05], PLAN.width + 0.001, raised)
    assert action.translation.tolist() == [0.0, 0.0, LIFT_STEP]
    assert action.width < 0.0


def test_tofu_is_picked_up_with_the_best_gap() -> None:
    fingers = stock_fingers()
    plan, holding = best_plan(fingers, 600, seed=0)
    assert 3 <= holding <= 16
    assert 0.0255 < plan.width < 0.0285
    env = ControlEnv(8, fingers, ControlConfig(tetrahedra=600))
    played = roll_out(env, _Restarting([fingers] * 8, [plan] * 8), seed=5, episodes=8)
    assert played.episodes["success"].mean() >= 0.85


def test_fingers_that_do_not_hold_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    wide = replace(PLAN, width=0.036)
    monkeypatch.setattr("codesign_policy.expert_plan.plan_for", lambda fingers: wide)
    with pytest.raises(DemonstrationError, match=r"no gap from 34.00 to 37.75 mm"):
        best_plan(stock_fingers(), 600, seed=0)


class _Restarting(ReactiveLanes):
    def restart(self, lanes: np.ndarray) -> None:
        """It remembers nothing."""
