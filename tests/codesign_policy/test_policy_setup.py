"""What a policy is made of gives the same policy again, and nothing else does."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from codesign_design.stock import stock_fingers
from codesign_policy.finger_plan import plan_for
from codesign_policy.policy import PolicySetup, Surroundings, load_policy
from codesign_policy.scripted import GraspPlan
from codesign_policy.task import Observation
from tests.codesign_policy.random_pair import random_pair

FINGERS = stock_fingers()
AROUND = Surroundings(0.003, FINGERS)


def answers(policy, count=60):
    """Actions for a hand that wanders, (count, 7)."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(count):
        seen = Observation(
            np.array([0.45, 0.0, 0.2]) + 0.01 * rng.normal(size=3),
            np.array([0.451, 0.002, 0.02]),
            0.05 + 0.001 * rng.normal(),
        )
        action = policy.act(seen)
        found.append([*action.translation, *action.rotation, action.width])
    return np.array(found)


def test_the_scripted_grasp_from_its_settings():
    plan = replace(plan_for(FINGERS), width=0.0271)
    setup = PolicySetup.of("scripted", AROUND, plan)
    assert (setup.file, setup.file_hash) == (b"", "")
    assert setup.settings["width"] == 0.0271
    assert setup.settings["table_height"] == 0.003
    assert setup.settings["tip_depth"] == FINGERS.tip_depth
    again = PolicySetup("scripted", settings=dict(setup.settings)).build(FINGERS)
    same = answers(load_policy("scripted", AROUND, plan))
    np.testing.assert_array_equal(answers(again), same)
    other = PolicySetup.of("scripted", AROUND, replace(plan, open_width=0.0461)).build(FINGERS)
    assert (answers(other) != same).any()


def test_a_trained_pair_from_what_its_file_held(tmp_path: Path):
    path = tmp_path / "policy.npz"
    random_pair(np.zeros(0)).save(path)
    content = path.read_bytes()
    setup = PolicySetup.of(str(path), AROUND)
    assert (setup.file, dict(setup.settings)) == (content, {})
    assert setup.file_hash == hashlib.sha256(content).hexdigest()
    same = answers(load_policy(str(path), AROUND))
    path.unlink()
    np.testing.assert_array_equal(answers(setup.build(FINGERS)), same)


def test_what_cannot_be_built_is_named(tmp_path: Path):
    with pytest.raises(ValueError, match="policy 'magic': unknown"):
        PolicySetup.of("magic", AROUND)
    with pytest.raises(ValueError, match=r"gone\.npz: not a trained pair"):
        PolicySetup("gone.npz", file=b"rubbish").build(FINGERS)
    with pytest.raises(ValueError, match=r"settings \['width'\] are not those"):
        PolicySetup("scripted", settings={"width": 0.03}).build(FINGERS)
    settings = dict(PolicySetup.of("scripted", AROUND).settings) | {"warp": 9.0}
    with pytest.raises(ValueError, match="warp"):
        PolicySetup("scripted", settings=settings).build(FINGERS)
    path = tmp_path / "policy.npz"
    random_pair(np.zeros(0)).save(path)
    with pytest.raises(ValueError, match="are in use"):
        PolicySetup.of(str(path), AROUND).build(stock_fingers(0.0012))


def test_a_slower_plan_takes_longer_over_the_same_way():
    plan = GraspPlan()
    slow = plan.slowed(0.25)
    assert (slow.speed, slow.close_speed) == (0.25 * plan.speed, 0.25 * plan.close_speed)
    assert slow.lift_time == 4.0 * plan.lift_time
    assert (
        replace(slow, speed=plan.speed, close_speed=plan.close_speed, lift_time=plan.lift_time)
        == plan
    )
    assert plan.slowed(1.0) == plan
    for pace in (0.0, -1.0, 1.1, float("nan")):
        with pytest.raises(ValueError, match="pace"):
            plan.slowed(pace)
