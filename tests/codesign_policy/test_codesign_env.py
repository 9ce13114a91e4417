"""The two-stage episode: designs become fingers, and void designs end at once."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from codesign_design.build import build_finger
from codesign_design.design_space import design_space
from codesign_policy.codesign_env import (
    COMPONENTS,
    INVALID_WEIGHT,
    CodesignEnv,
    built_design,
    reward_weights,
)
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.env_pool import PooledControlEnv
from codesign_policy.lanes import STEP_INFO
from codesign_policy.replay import ReplayBuffer, Spaces
from codesign_policy.reward import RewardWeights
from codesign_policy.rounds import Episodes, play_round
from codesign_policy.task import design_stage_observation
from codesign_policy.tool import ToolStart

SPACE = "box-12"
COUNT = design_space(SPACE).parameter_count
CONFIG = ControlConfig(start=ToolStart((0.45, 0.0, 0.02), 0.034), episode_steps=10)
VOID = np.tile([0.9, -0.9, 0.9], COUNT // 3) * np.tile([1.0, 1.0, 1.0, -1.0], COUNT // 4)
CLOSE = np.tile([0.0] * 6 + [-0.5], (4, 1))


def small(seed: int) -> np.ndarray:
    """Designs near the base mesh, (4, D)."""
    return np.random.default_rng(seed).normal(0.0, 0.005, (4, COUNT)).astype(np.float32)


@pytest.fixture(scope="module")
def env() -> CodesignEnv:
    return CodesignEnv(SPACE, 4, config=CONFIG)


def play(env: CodesignEnv, lane: int, steps: int = 10) -> list[np.ndarray]:
    seen = []
    for _ in range(steps):
        observations, rewards, terminated, truncated, info = env.step(CLOSE)
        seen += [observations[lane], rewards[lane], terminated[lane], truncated[lane]]
        seen += [info[name][lane] for name in STEP_INFO]
    return seen


def test_the_rest_design_is_the_base_mesh_built(env: CodesignEnv) -> None:
    observations, info = env.reset(seed=0, options={"designs": np.zeros((4, COUNT))})
    expected = build_finger(design_space(SPACE).surface(np.zeros(COUNT)), cage=SPACE).pair
    assert {pair.content_hash for pair in env.fingers} == {expected.content_hash}
    assert info["design_valid"].all()
    assert observations in env.observation_space
    assert not observations[:, 8:].any()


def test_observations_hold_the_design_and_the_stage(env: CodesignEnv) -> None:
    designs = small(0)
    observations, _ = env.reset(seed=0, options={"designs": designs})
    np.testing.assert_array_equal(observations[:, 8:], designs)
    assert observations[:, 7].tolist() == [1.0] * 4
    assert env.design_observation.shape == env.single_observation_space.shape
    assert env.design_observation[7] == 0.0
    np.testing.assert_array_equal(env.design_observation, design_stage_observation(COUNT))
    again, _ = env.reset(seed=0)  # the designs stay
    np.testing.assert_array_equal(again, observations)


def test_a_lane_does_not_depend_on_the_designs_of_its_neighbours(env: CodesignEnv) -> None:
    mine, others = small(0), small(1)
    others[1] = mine[1]
    others[3] = VOID
    seen = []
    for designs in (mine, others):
        env.reset(seed=5, options={"designs": designs})
        seen.append(play(env, 1))
    for a, b in zip(*seen, strict=True):
        assert np.array_equal(a, b, equal_nan=True)
    assert env.step(CLOSE)[4]["contact"][1]  # fingers did touch, so they could have differed


def test_it_is_the_control_stage_with_those_fingers(env: CodesignEnv) -> None:
    designs = small(0)
    pairs = [built_design(SPACE, tuple(map(float, design))).fingers for design in designs]
    plain = ControlEnv(4, pairs, CONFIG, AutoresetMode.DISABLED)  # type: ignore[arg-type]
    np.testing.assert_array_equal(
        env.reset(seed=2, options={"designs": designs})[0], plain.reset(seed=2)[0]
    )
    for _ in range(10):
        mine, other = env.step(CLOSE), plain.step(CLOSE)
        for a, b in zip(mine[:4], other[:4], strict=True):
            np.testing.assert_array_equal(a, b)
    assert mine[4]["final_info"]["steps"].tolist() == [10] * 4


def test_a_void_design_ends_at_once_and_says_why(env: CodesignEnv) -> None:
    assert built_design(SPACE, tuple(VOID)).problems
    designs = small(0)
    designs[2] = VOID
    first, info = env.reset(seed=0, options={"designs": designs})
    assert info["design_valid"].tolist() == [True, True, False, True]
    assert [bool(why) for why in env.problems] == [False, False, True, False]
    np.testing.assert_array_equal(first[2, 8:], designs[2])
    observations, rewards, terminated, truncated, info = env.step(CLOSE)
    assert terminated.tolist() == [False, False, True, False]
    assert not truncated.any()
    assert rewards[2] == -INVALID_WEIGHT
    assert info["reward_invalid"].tolist() == [0.0, 0.0, -1.0, 0.0]
    assert not info["final_info"]["success"][2]
    assert np.isnan(info["final_info"]["top10_stress"][2])
    assert info["_final_info"].tolist() == [False, False, True, False]
    np.testing.assert_array_equal(observations[2], first[2])
    for step in range(1, 10):
        _, rewards, terminated, truncated, info = env.step(CLOSE)
        assert rewards[2] == 0.0
        assert terminated[2]
        assert ("final_info" in info) == (step == 9)
    assert info["_final_info"].tolist() == [True, True, False, True]
    assert truncated.tolist() == [True, True, False, True]


def test_rounds_store_both_stages_and_the_penalty_of_void_designs(env: CodesignEnv) -> None:
    designs = small(0)
    designs[0] = VOID
    buffer = ReplayBuffer(Spaces(8 + COUNT, COUNT, 7), COMPONENTS, 100)
    episodes = Episodes(env, COMPONENTS, ("success", "top10_stress"), env.design_observation)
    played = play_round(episodes, 0, lambda seen: CLOSE.astype(np.float32), buffer, designs)
    assert played.transitions == 1 + 3 * 10
    np.testing.assert_array_equal(buffer.designs, designs)
    weights = reward_weights(replace(RewardWeights(), stress=1e-4))
    assert weights == {**asdict(RewardWeights()), "stress": 1e-4, "invalid": INVALID_WEIGHT}
    rewards = buffer.reward(weights)
    assert rewards[buffer.rows.terminated].tolist() == [-INVALID_WEIGHT]
    assert np.isnan(played.metrics["top10_stress"][0])


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"designs": np.zeros((4, 3))}, r"shape \(4, 3\): give one row per lane, \(4, 36\)"),
        ({"designs": np.full((4, COUNT), np.nan)}, "lane 0: parameter 0 is nan"),
        ({"designs": np.full((4, COUNT), 1.1)}, r"1\.1; it must be within \[-1, 1\]: clip it"),
        ({"design": None}, r"\['design'\] are unknown: there are \['designs'\]"),
    ],
)
def test_bad_designs_and_options_are_refused(env: CodesignEnv, options: dict, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        env.reset(options=options)


def test_the_control_stage_refuses_unknown_options() -> None:
    with pytest.raises(ValueError, match=r"\['designs'\] are unknown"):
        ControlEnv(4, config=CONFIG).reset(options={"designs": small(0)})


def test_several_processes_give_the_same_bits(env: CodesignEnv) -> None:
    pooled = CodesignEnv(SPACE, 8, processes=2, config=CONFIG)
    try:
        assert isinstance(pooled.control, PooledControlEnv)
        with pytest.raises(ValueError, match=r"\['fingers_'\] are unknown"):
            pooled.control.reset(options={"fingers_": {}})
        designs = small(0)
        designs[1] = VOID
        both = np.concatenate([designs, designs])
        many, _ = pooled.reset(seed=0, options={"designs": both})
        few, _ = env.reset(seed=0, options={"designs": designs})
        np.testing.assert_array_equal(many[:4], few)
        for _ in range(10):
            many, few = pooled.step(np.tile(CLOSE, (2, 1))), env.step(CLOSE)  # type: ignore[assignment]
            for a, b in zip(many[:4], few[:4], strict=True):
                np.testing.assert_array_equal(a[:4], b)
    finally:
        pooled.close()
