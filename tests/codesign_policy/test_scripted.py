"""The scripted grasp against an arm that follows exactly, late, or loses actions."""

from collections import deque

import numpy as np
import pytest

from codesign_design.stock import stock_fingers
from codesign_policy.policy import Surroundings, load_policy, policy_names
from codesign_policy.scripted import GraspPlan, ScriptedGrasp
from codesign_policy.task import ACTION_SCALE, Observation

OBJECT = np.array([0.452, -0.003, 0.0195])
PLAN = GraspPlan()
TIP = 0.0054


def grasp() -> ScriptedGrasp:
    return ScriptedGrasp(PLAN, 0.0, tip_depth=TIP, min_width=0.0)


def run(
    policy: ScriptedGrasp, *, delay: int = 0, lost: frozenset[int] = frozenset()
) -> dict[str, np.ndarray]:
    """Integrates actions on a commanded state that is seen `delay` periods late.

    Returns:
        The state (position, gap) at the end of each phase.
    """
    state = np.array([0.45, 0.0, 0.25, 0.06])
    history = deque([state] * (delay + 1), maxlen=delay + 1)
    ends: dict[str, np.ndarray] = {}
    for step in range(600):
        seen = history[0]
        action = policy.act(Observation(seen[:3], OBJECT, float(seen[3])))
        assert np.abs(action.normalised()).max() <= 1.0 + 1e-12
        assert np.all(action.rotation == 0.0)
        if step not in lost:
            state = state + np.append(action.translation, action.width)
        history.append(state)
        ends[policy.phase] = state
        if policy.done:
            return ends
    pytest.fail("never done")


def test_phases_end_where_the_plan_says() -> None:
    ends = run(grasp())
    assert list(ends) == ["approach", "descend", "close", "settle", "lift", "hold"]
    down = [OBJECT[0], OBJECT[1], PLAN.clearance + TIP]
    np.testing.assert_allclose(ends["descend"], [*down, PLAN.open_width], atol=1e-9)
    np.testing.assert_allclose(ends["close"], [*down, PLAN.width], atol=1e-9)
    lifted = [down[0], down[1], down[2] + PLAN.lift, PLAN.width]
    np.testing.assert_allclose(ends["hold"], lifted, atol=1e-9)


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_a_late_arm_gets_no_overshoot(delay: int) -> None:
    ends = run(grasp(), delay=delay)
    np.testing.assert_allclose(ends["settle"][3], PLAN.width, atol=5e-5)
    np.testing.assert_allclose(ends["hold"][2], PLAN.clearance + TIP + PLAN.lift, atol=1e-4)


def test_lost_actions_are_made_up_for_before_the_lift() -> None:
    lost = frozenset(range(70, 90, 4))
    ends = run(grasp(), delay=1, lost=lost)
    shortfall = abs(run(grasp(), delay=1, lost=lost)["close"][3] - PLAN.width)
    assert shortfall > 5e-4  # the loss is real ...
    assert abs(ends["settle"][3] - PLAN.width) < 0.15 * shortfall  # ... and mostly gone


def test_moves_no_faster_than_planned() -> None:
    policy = grasp()
    state = np.array([0.45, 0.0, 0.25, 0.06])
    speeds, closing = [], []
    while not policy.done:
        action = policy.act(Observation(state[:3], OBJECT, float(state[3])))
        speeds.append(np.linalg.norm(action.translation) / 0.05)
        closing.append(-action.width / 0.05)
        state = state + np.append(action.translation, action.width)
    assert max(speeds) <= 1.05 * PLAN.speed
    assert max(closing) <= 2.1 * PLAN.close_speed
    assert max(np.abs(np.diff(speeds))) < ACTION_SCALE[0] / 0.05  # no start or stop in one step


def test_goes_on_holding_when_done_and_starts_anew_after_reset() -> None:
    policy = grasp()
    run(policy)
    here = Observation(
        np.array([*OBJECT[:2], PLAN.clearance + TIP + PLAN.lift]), OBJECT, PLAN.width
    )
    assert np.abs(policy.act(here).normalised()).max() < 0.05
    policy.reset()
    assert policy.phase == "idle"
    assert next(iter(run(policy))) == "approach"


def test_refuses_fingers_that_cannot_close_far_enough() -> None:
    with pytest.raises(ValueError, match=r"0\.0273.*0\.03 m and more"):
        ScriptedGrasp(PLAN, 0.0, tip_depth=TIP, min_width=0.03)


def test_policies_are_loaded_by_name() -> None:
    around = Surroundings(table_height=0.0, fingers=stock_fingers())
    assert "scripted" in policy_names()
    assert load_policy("scripted", around).phase == "idle"
    with pytest.raises(ValueError, match="policy 'magic': unknown; there are scripted"):
        load_policy("magic", around)
