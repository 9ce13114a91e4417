"""A trained pair served as a policy acts as it does in the lanes it was trained in."""

from dataclasses import replace

import numpy as np
import pytest

from codesign_design.stock import stock_fingers
from codesign_policy.control_env import ControlEnv
from codesign_policy.learned import LearnedGrasp, mismatch
from codesign_policy.policy import Surroundings, load_policy
from codesign_policy.task import EPISODE_STEPS, Observation
from tests.codesign_policy.random_pair import PARAMETERS, SPACE, random_pair

STOCK = stock_fingers()
DESIGN = np.linspace(-0.5, 0.5, PARAMETERS)
HERE = Observation(np.array([0.45, 0.01, 0.2]), np.array([0.45, 0.0, 0.02]), 0.06)


def designed(parameters: np.ndarray) -> object:
    return replace(STOCK, name="mine", cage=SPACE, parameters=tuple(parameters.tolist()))


def test_acts_as_in_the_lanes() -> None:
    """Observation by observation, to the rounding of single precision."""
    pair, env = random_pair(), ControlEnv(2)
    policy = LearnedGrasp(pair, STOCK)
    seen, _ = env.reset(seed=3)
    for _ in range(5):
        actions = pair.act(seen)
        served = policy.act(Observation.from_normalised(seen[0])).normalised()
        np.testing.assert_allclose(served, actions[0], atol=1e-5)
        seen, *_ = env.step(actions)


def test_is_done_when_the_last_step_has_been_made() -> None:
    policy = LearnedGrasp(random_pair(), STOCK)
    assert (policy.phase, policy.done) == ("idle", False)
    for _ in range(EPISODE_STEPS):
        assert np.abs(policy.act(HERE).normalised()).max() > 0.0
        assert (policy.phase, policy.done) == ("control", False)
    assert not policy.act(HERE).normalised().any()
    assert (policy.phase, policy.done) == ("done", True)
    policy.reset()
    assert (policy.phase, policy.done) == ("idle", False)


def test_the_design_is_observed() -> None:
    pair = random_pair(DESIGN)
    policy = LearnedGrasp(pair, designed(DESIGN))
    seen = replace(HERE, design=DESIGN)
    expected = pair.act(seen.normalised())
    np.testing.assert_allclose(policy.act(seen).normalised(), expected, atol=1e-6)


def test_fingers_must_be_the_pairs_own() -> None:
    assert mismatch(random_pair(), STOCK) == ""
    assert mismatch(random_pair(DESIGN), designed(DESIGN.astype(np.float32))) == ""
    other = DESIGN.copy()
    other[4] += 1e-3
    for pair, fingers, words in (
        (random_pair(), replace(STOCK, max_width=0.08), "trained with the stock fingers"),
        (random_pair(DESIGN), STOCK, "made without a cage, .* a design of 'box-7'"),
        (random_pair(DESIGN), replace(designed(DESIGN), cage="box-12"), "of 'box-12', .* 'box-7'"),
        (random_pair(DESIGN), designed(DESIGN[:3]), "with 3 parameters, .* with 21"),
        (random_pair(DESIGN), designed(other), r"parameter 4 is -0\.299, .* with -0\.3"),
        (random_pair(DESIGN), designed(DESIGN * np.nan), "parameter 0 is nan"),
    ):
        with pytest.raises(ValueError, match=words):
            LearnedGrasp(pair, fingers)


def test_an_actor_for_other_observations_is_refused() -> None:
    pair = random_pair()
    wide = replace(pair, weights=(np.zeros((9, 16), np.float32), *pair.weights[1:]))
    with pytest.raises(ValueError, match=r"takes 9 numbers .* have 8"):
        LearnedGrasp(wide, STOCK)


def test_is_loaded_by_its_path(tmp_path) -> None:
    random_pair().save(tmp_path / "policy.npz")
    around = Surroundings(0.0, STOCK)
    for name in (tmp_path, tmp_path / "policy.npz"):
        assert load_policy(str(name), around).phase == "idle"
    with pytest.raises(ValueError, match="in use, the policy was trained with the stock"):
        load_policy(str(tmp_path), Surroundings(0.0, replace(STOCK, min_width=0.01)))
