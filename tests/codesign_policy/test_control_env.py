"""The control stage as a vector environment."""

import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from codesign_design.stock import stock_fingers
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.domain import TrialDomain, draw_domain
from codesign_policy.lanes import FINAL_INFO, STEP_INFO, episode_seed
from codesign_policy.reward import RewardComponents, RewardWeights, weighted
from codesign_policy.task import Observation
from codesign_policy.tofu_grasp import ID, TofuGrasp
from codesign_policy.tool import ToolStart

AROUND = ToolStart((0.45, 0.0, 0.01), 0.038)  # fingers beside the block
SHORT = ControlConfig(start=AROUND, episode_steps=12)
LONG = ControlConfig(start=AROUND)


def actions(seed: int, steps: int, lanes: int) -> np.ndarray:
    """Rough ones: each is kept for five steps; all close and come down at first."""
    random = np.random.default_rng(seed)
    drawn = np.repeat(random.uniform(-1, 1, (-(-steps // 5), lanes, 7)), 5, axis=0)[:steps]
    drawn[:6, :, 6] = -1.0
    return drawn


def play(env: ControlEnv, moves: np.ndarray, lane: int) -> list[np.ndarray]:
    """What a lane sees and gets."""
    seen = []
    for move in moves:
        observations, rewards, terminated, truncated, info = env.step(move)
        seen += [observations[lane], rewards[lane], terminated[lane], truncated[lane]]
        seen += [info[name][lane] for name in STEP_INFO]
        if "final_info" in info:
            seen += [info["final_obs"][lane]]
            seen += [info["final_info"][name][lane] for name in FINAL_INFO]
    return seen


def assert_same_bits(one: list[np.ndarray], other: list[np.ndarray]) -> None:
    assert len(one) == len(other)
    for a, b in zip(one, other, strict=True):
        assert np.array_equal(a, b, equal_nan=True)


def test_the_checker_passes_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(ID, config=SHORT)
        check_env(env.unwrapped)
        env.close()
        lanes = gymnasium.make_vec(ID, 4, vectorization_mode="vector_entry_point", config=SHORT)
    assert isinstance(lanes, ControlEnv)
    assert lanes.reset(seed=0)[0] in lanes.observation_space
    lanes.close()


def test_observations_are_those_of_the_policy_node() -> None:
    env = ControlEnv(4, config=LONG)
    observations, info = env.reset(seed=7)
    assert observations in env.observation_space
    assert info["episode_seed"].tolist() == [7, 8, 9, 10]
    for lane, vector in enumerate(observations):
        seen, domain = Observation.from_normalised(vector), draw_domain(7 + lane)
        np.testing.assert_allclose(seen.tcp_position, AROUND.position, atol=1e-7)
        np.testing.assert_allclose(seen.object_position[:2], [domain.x, domain.y], atol=1e-5)
        assert seen.object_position[2] == pytest.approx(0.0195, abs=3e-4)  # 20 mm less the sag
        assert seen.width == pytest.approx(AROUND.width)
        np.testing.assert_allclose(seen.normalised(), vector, atol=1e-6)
        assert env.domains[lane] == domain


def test_a_lane_does_not_depend_on_its_neighbours() -> None:
    mine, moves = 3, actions(1, 30, 8)
    other = actions(2, 30, 8)
    other[:, mine] = moves[:, mine]
    runs = []
    for each in (moves, other):
        env = ControlEnv(8, config=SHORT)
        env.reset(seed=3)
        runs.append(play(env, each, mine))
    assert_same_bits(*runs)
    row = 4 + len(STEP_INFO)
    contact = runs[0][4 + list(STEP_INFO).index("contact") : 12 * row : row]
    assert any(contact)  # it was about something


def test_a_lane_does_not_depend_on_its_place_or_on_how_many_there_are() -> None:
    moves = actions(4, 26, 12)
    few = ControlEnv(5, config=SHORT)
    few.reset(seed=20)
    many = ControlEnv(12, config=SHORT)
    many.reset(seed=12)  # lane 10 draws from seed 22, as lane 2 of the few
    small = moves[:, :5].copy()
    small[:, 2] = moves[:, 10]
    assert_same_bits(play(few, small, 2), play(many, moves, 10))


def test_seeds_repeat_and_later_episodes_differ() -> None:
    env = ControlEnv(4, config=SHORT)
    moves = actions(5, 24, 4)  # two episodes, the second started by itself
    first, _ = env.reset(seed=1)
    one = play(env, moves, 0)
    second_seeds = env.episode_seeds.copy()
    again, _ = env.reset(seed=1)
    assert np.array_equal(first, again)
    assert_same_bits(one, play(env, moves, 0))
    third, _ = env.reset()
    assert not np.array_equal(third, first)
    assert second_seeds.tolist() == [episode_seed(1 + lane, 2) for lane in range(4)]
    assert len(set(second_seeds)) == 4
    other, _ = env.reset(seed=2)
    assert not np.array_equal(other, first)


def test_lanes_end_and_restart_on_their_own() -> None:
    env = ControlEnv(4, config=SHORT)
    env.reset(seed=0)
    still = np.zeros((4, 7))
    for _ in range(5):
        env.step(still)
    mask = np.array([False, True, False, False])
    env.reset(options={"reset_mask": mask})
    for step in range(1, 13):
        observations, _, terminated, truncated, info = env.step(still)
        assert not terminated.any()
        assert truncated.tolist() == [step == 7, step == 12, step == 7, step == 7]
        if step not in (7, 12):
            assert "final_info" not in info
            continue
        ended = ~mask if step == 7 else mask
        assert np.array_equal(info["_final_obs"], ended)
        assert np.array_equal(info["_final_info"], ended)
        assert info["final_info"]["steps"].tolist() == np.where(ended, 12, 0).tolist()
        assert np.isnan(info["final_info"]["top10_stress"][ended]).all()  # never touched
        last = [Observation.from_normalised(o) for o in info["final_obs"][ended]]
        new = [Observation.from_normalised(o) for o in observations[ended]]
        for a, b in zip(last, new, strict=True):
            assert np.abs(a.object_position - b.object_position).max() > 1e-4  # drawn anew


def test_without_autoreset_an_ended_lane_waits() -> None:
    env = ControlEnv(4, config=SHORT, autoreset_mode=AutoresetMode.DISABLED)
    env.reset(seed=0)
    moves = actions(6, 14, 4)
    for move in moves[:12]:
        _, _, _, truncated, info = env.step(move)
    assert truncated.all()
    assert info["_final_info"].all()
    observations, rewards, _, truncated, info = env.step(moves[12])
    assert truncated.all()
    assert not rewards.any()
    assert "final_info" not in info
    mask = np.array([True, False, False, True])
    env.reset(options={"reset_mask": mask})
    after, rewards, _, truncated, _ = env.step(moves[13])
    assert truncated.tolist() == [False, True, True, False]
    assert (rewards != 0.0).tolist() == [True, False, False, True]
    assert np.array_equal(after[1, 6], observations[1, 6])  # the gap does not move


def test_rewards_are_the_weighted_components() -> None:
    weights = RewardWeights(lift=3.0, held=2.0, contact=0.7, distance=1.1, stress=2e-3)
    env = ControlEnv(4, config=ControlConfig(start=AROUND, weights=weights))
    env.reset(seed=0)
    for move in actions(7, 15, 4):
        _, rewards, _, _, info = env.step(move)
    parts = {n.removeprefix("reward_"): info[n] for n in STEP_INFO if n.startswith("reward_")}
    np.testing.assert_allclose(rewards, weighted(RewardComponents(**parts), weights))
    assert (parts["stress"] < 0.0).any()
    assert (parts["contact"] > 0.0).any()


def test_a_lost_block_ends_the_episode_if_asked_to() -> None:
    domain = TrialDomain(x=0.45, y=0.0)
    for asked in (True, False):
        env = ControlEnv(1, config=ControlConfig(start=AROUND, domain=domain, end_when_lost=asked))
        env.reset(seed=0)
        ended = []
        for step in range(60):
            move = np.zeros((1, 7))
            move[0, 6] = -0.8 if step < 6 else (1.0 if step >= 40 else 0.0)
            move[0, 2] = 0.5 if 15 <= step < 35 else 0.0
            _, _, terminated, _, info = env.step(move)
            ended.append(bool(terminated[0]))
            if step == 38:
                assert info["rise"][0] > 0.03
        assert any(ended) is asked
        assert not any(ended[:40])


def test_fingers_are_swapped_in_lanes_that_are_reset() -> None:
    moves = actions(8, 20, 4)
    mask = np.array([False, True, False, False])
    rounder = replace(stock_fingers(edge_radius=0.0014), min_width=0.02)
    runs = []
    for new in ({1: rounder}, {}):
        env = ControlEnv(4, config=LONG)
        env.reset(seed=0)
        play(env, moves[:8], 0)
        env.reset(options={"reset_mask": mask, "fingers": new})
        runs.append([play(env, moves[8:14], 0), play(env, moves[:6], 1)])
        if new:
            assert env.fingers[1] is rounder
            for _ in range(20):
                observations, *_ = env.step(np.tile([0, 0, 0, 0, 0, 0, -1.0], (4, 1)))
            widths = [Observation.from_normalised(o).width for o in observations]
            assert widths[1] == pytest.approx(0.02)
            assert widths[0] == pytest.approx(0.01)
    assert_same_bits(runs[0][0], runs[1][0])
    stress = 5 * (4 + len(STEP_INFO)) + 4 + list(STEP_INFO).index("top10_stress")
    assert runs[0][1][stress] != runs[1][1][stress]
    with pytest.raises(ValueError, match=r"lanes \[2\], which are not reset"):
        env.reset(options={"reset_mask": mask, "fingers": {2: rounder}})
    other = replace(rounder, parameters=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"design parameters: .* one design space"):
        env.reset(options={"reset_mask": mask, "fingers": {1: other}})


def test_friction_is_drawn_from_its_range() -> None:
    env = ControlEnv(8, config=ControlConfig(friction=(0.4, 0.6), episode_steps=12))
    env.reset(seed=0)
    drawn = [domain.friction for domain in env.domains]
    assert len(set(drawn)) == 8
    assert 0.4 <= min(drawn) < max(drawn) <= 0.6
    assert [d.x for d in env.domains] == [draw_domain(k).x for k in range(8)]


@pytest.mark.parametrize("value", [np.nan, np.inf, 1.1, -2.0])
def test_bad_actions_name_the_lane(value: float) -> None:
    env = ControlEnv(4, config=SHORT)
    env.reset(seed=0)
    bad = np.zeros((4, 7))
    bad[2, 6] = value
    with pytest.raises(ValueError, match=rf"lane 2: dw is {value}"):
        env.step(bad)
    with pytest.raises(ValueError, match=r"\(4, 6\).*7 numbers for 4"):
        env.step(np.zeros((4, 6)))
    env.step(np.zeros((4, 7)))


def test_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ValueError, match="NEXT_STEP"):
        ControlEnv(4, autoreset_mode=AutoresetMode.NEXT_STEP)
    with pytest.raises(ValueError, match=r"friction range \(0\.6, 0\.4\)"):
        ControlEnv(4, config=ControlConfig(friction=(0.6, 0.4)))
    env = ControlEnv(4, config=SHORT)
    with pytest.raises(RuntimeError, match=r"call reset\(\)"):
        env.step(np.zeros((4, 7)))
    with pytest.raises(ValueError, match="never reset"):
        env.reset(options={"reset_mask": np.array([True, False, False, False])})
    with pytest.raises(ValueError, match="give 4 flags"):
        env.reset(options={"reset_mask": np.zeros(4, dtype=bool)})


def test_a_single_lane_tells_its_metrics_at_the_end() -> None:
    env = TofuGrasp(config=SHORT)
    env.reset(seed=0)
    for _ in range(12):
        _, _, terminated, truncated, info = env.step(np.zeros(7))
    assert truncated
    assert not terminated
    assert info["final_info"]["steps"] == 12
    assert info["final_info"]["success"] is False
    assert set(info) == {*STEP_INFO, "final_info"}
