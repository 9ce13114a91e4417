"""The loop on a toy task with a known optimum: rounds, resuming, interruption, learning."""

import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_task import BEST, BEST_RETURN, COMPONENTS, SPACES, STEPS, WEIGHTS, ToyEnv, toy_episodes

from codesign_policy.checkpoint import load_checkpoint
from codesign_policy.interruption import Interruption
from codesign_policy.presets import FAST
from codesign_policy.proposals import DesignSearch, SearchSettings
from codesign_policy.replay import FIELDS, ReplayBuffer, Spaces
from codesign_policy.rlpd import Agent, LearningError
from codesign_policy.rounds import Episodes, play_round
from codesign_policy.tensorboard_log import TensorBoardLog
from codesign_policy.training import Progress, Training, TrainingConfig

# Its observations are not those of the grasp, its two numbers need less entropy than seven.
TOY = replace(FAST, encoding=False, design_scale=1.0, control_entropy=-4.0, control_temperature=0.1)
QUICK = replace(TOY, hidden=(16,), batch_size=16, design_rows=4, start_transitions=40)
METRICS = ("success", "peak_lift", "top10_stress", "median_stress")
CONFIG = TrainingConfig(transitions=160, reward_weights=WEIGHTS, seed=1, capacity=1000)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def demonstrations() -> ReplayBuffer:
    """Four episodes at two designs, straight to the target."""
    buffer, env = ReplayBuffer(SPACES, COMPONENTS, 24), ToyEnv(4)
    episodes = Episodes(env, COMPONENTS, (), np.zeros(5, np.float32))

    def straight(observation: np.ndarray) -> np.ndarray:
        away = env.targets() - observation[:, :2]
        return np.clip(away / 0.2, -1.0, 1.0).astype(np.float32)

    designs = np.array([[0.0, 0.0], [-0.4, 0.1]] * 2, np.float32)
    play_round(episodes, 0, straight, buffer, designs)
    return buffer


def training(lanes: int = 8, agent_seed: int = 0, **change: Any) -> Training:
    agent = Agent(SPACES, QUICK, agent_seed)
    return Training(agent, toy_episodes(lanes), replace(CONFIG, **change), demonstrations())


def test_a_round_stores_both_stages() -> None:
    buffer, env = ReplayBuffer(SPACES, COMPONENTS, 100), ToyEnv(3)
    episodes = Episodes(env, COMPONENTS, ("success",), np.full(5, 7.0, np.float32))
    designs = np.array([[0.3, -0.2], [0.0, 0.5], [1.0, -1.0]], np.float32)
    stay = np.zeros((3, 2), np.float32)
    played = play_round(episodes, 5, lambda observation: stay, buffer, designs)
    rows = buffer.rows
    assert played.transitions == 3 * STEPS == rows.in_control.sum()
    np.testing.assert_array_equal(buffer.designs, designs)
    assert (rows.observation[:3] == 7.0).all()
    first, _ = env.reset(seed=5, options={"designs": designs})
    np.testing.assert_array_equal(rows.next_observation[:3], first)
    np.testing.assert_array_equal(rows.observation[3:6], first)
    assert rows.truncated[-3:].all()
    assert not rows.truncated[:-3].any()
    assert not rows.terminated.any()
    # Standing still at about the origin, 0.5 from the target: 5 steps of each component.
    np.testing.assert_allclose(played.component_sums[:, 0], -2.5, atol=0.15)
    shape = -STEPS * ((designs - BEST) ** 2).sum(axis=1)
    np.testing.assert_allclose(played.component_sums[:, 1], shape, rtol=1e-5)
    np.testing.assert_array_equal(played.metrics["success"], [0.0, 0.0, 0.0])


class EarlyEnd(ToyEnv):
    """Lane k terminates after k + 1 steps and then reports nonsense that must not be stored."""

    def step(self, actions: np.ndarray) -> Any:
        observation, reward, _, truncated, info = super().step(actions)
        over = self._steps > np.arange(self.num_envs)
        observation[self._steps > np.arange(self.num_envs) + 1] = np.nan
        info["final_info"] = {"success": np.full(self.num_envs, float(self._steps))}
        return observation, reward, over, truncated, info


def test_lanes_that_end_early_rest() -> None:
    buffer = ReplayBuffer(SPACES, COMPONENTS, 100)
    episodes = Episodes(EarlyEnd(4), COMPONENTS, ("success",))
    calls: list[int] = []
    played = play_round(
        episodes, 0, lambda o: np.zeros((4, 2), np.float32), buffer, after_step=calls.append
    )
    assert calls == [4, 3, 2, 1]
    assert played.transitions == len(buffer) == 10
    assert buffer.rows.terminated.sum() == 4
    np.testing.assert_array_equal(played.metrics["success"], [1.0, 2.0, 3.0, 4.0])


def test_updates_per_transition_and_their_start() -> None:
    """A quarter of an update per transition after the first 40; random actions until then."""
    run = training()
    rounds: list[Progress] = []
    run.run(on_round=rounds.append)
    assert [r.transitions for r in rounds] == [40, 80, 120, 160]
    assert [r.updates for r in rounds] == [0, 10, 20, 30]
    assert run.agent.updates == 30
    assert len(run.experience) == 4 * (8 + 40)
    first = run.experience.rows.action[8:48, 2:]
    assert np.abs(first).max() > 0.9  # uniform; the new actor's spread is far smaller
    assert rounds[0].losses == {}
    assert {"critic_loss", "control_entropy", "design_entropy"} <= rounds[-1].losses.keys()
    assert all(set(r.seconds) == {"simulation", "updates", "rest"} for r in rounds)
    assert rounds[-1].seconds_left == 0.0
    returns = run.experience.reward(WEIGHTS)[48:96].reshape(-1, 8).sum(axis=0)
    np.testing.assert_allclose(rounds[1].returns, returns, rtol=1e-5)


def test_published_ratio() -> None:
    agent = Agent(SPACES, replace(QUICK, updates_per_transition=20.0, actor_period=20), 0)
    run = Training(agent, toy_episodes(4), replace(CONFIG, transitions=44))
    rounds: list[Progress] = []
    run.run(on_round=rounds.append)
    assert rounds[-1].transitions == 60
    assert rounds[-1].updates == 20 * (60 - 40)


def equal(one: Training, two: Training) -> None:
    """Weights, moments, experience and history, to the bit."""
    first, second = one.agent.state(), two.agent.state()
    for kind in ("networks", "optimizers"):
        flat = [torch.utils._pytree.tree_flatten(state[kind])[0] for state in (first, second)]
        for a, b in zip(*flat, strict=True):
            assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b
    assert torch.equal(first["random"], second["random"])
    for name in FIELDS:
        np.testing.assert_array_equal(
            getattr(one.experience.rows, name), getattr(two.experience.rows, name)
        )
    assert one.history == two.history


@pytest.mark.parametrize("capacity", [1000, 90])  # 90: old rows are overwritten meanwhile
def test_resuming_equals_never_having_stopped(tmp_path: Path, capacity: int) -> None:
    whole = training(capacity=capacity)
    whole.run()
    begun = training(capacity=capacity)
    begun.run(tmp_path, stop=lambda: len(begun.history) == 2)
    assert not begun.done
    resumed = training(capacity=capacity, agent_seed=77)  # its own start must not matter
    resumed.restore(load_checkpoint(tmp_path))
    resumed.run(tmp_path)
    equal(whole, resumed)
    assert len(whole.history) == 4


class Graded(ToyEnv):
    """Ends with the metrics that a search for designs looks at."""

    def step(self, actions: np.ndarray) -> Any:
        *rest, info = super().step(actions)
        if "final_info" in info:
            away = ((self._designs - BEST) ** 2).sum(axis=1)
            stress = {"top10_stress": 1e3 * away, "median_stress": 1e2 * away}
            info["final_info"] |= {"peak_lift": np.full(self.num_envs, 0.1), **stress}
        return *rest, info


def test_a_resumed_search_for_designs_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    def searching() -> Training:
        search = DesignSearch(np.zeros(2), 8, SearchSettings(rounds=1, practice=1), seed=4)
        episodes = Episodes(Graded(8), COMPONENTS, METRICS, np.zeros(5, np.float32))
        return Training(Agent(SPACES, QUICK, 0), episodes, CONFIG, demonstrations(), search)

    whole = searching()
    whole.run()
    begun, resumed = searching(), searching()
    begun.run(tmp_path, stop=lambda: len(begun.history) == 3)
    resumed.restore(load_checkpoint(tmp_path))
    resumed.run()
    equal(whole, resumed)


def test_a_finished_run_may_be_given_a_larger_budget(tmp_path: Path) -> None:
    begun = training(transitions=80)
    begun.run(tmp_path)
    more = training(transitions=160)
    more.restore(load_checkpoint(tmp_path))
    more.run()
    whole = training()
    whole.run()
    equal(whole, more)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 2}, r"training\.seed was 1 .* is 2 now"),
        ({"lanes": 4}, r"lanes was 8 .* is 4 now"),
        ({"reward_weights": {"distance": 1.0, "design": 5.0}}, r"reward_weights\.design was 10"),
    ],
)
def test_resuming_with_other_settings_is_refused(
    tmp_path: Path, change: dict, message: str
) -> None:
    begun = training(transitions=40)
    begun.run(tmp_path)
    with pytest.raises(ValueError, match=message):
        training(**change).restore(load_checkpoint(tmp_path))


def test_checkpoints_are_written_now_and_then(tmp_path: Path) -> None:
    run = training(checkpoint_period=0.0)
    seen = []
    run.run(tmp_path, on_round=lambda p: seen.append((tmp_path / "checkpoint.pt").exists()))
    assert seen == [False, True, True, True]
    table = (tmp_path / "history.csv").read_text().splitlines()
    assert table[0].startswith("round,transitions,updates,episode_return,success")
    assert len(table) == 1 + 4


def test_an_interruption_ends_the_round_and_saves(tmp_path: Path) -> None:
    run = training()
    with Interruption() as interrupted:

        def press(progress: Progress) -> None:
            if progress.round == 2:
                os.kill(os.getpid(), signal.SIGINT)

        run.run(tmp_path, on_round=press, stop=interrupted)
    assert interrupted()
    assert len(load_checkpoint(tmp_path).state["history"]) == 2
    with pytest.raises(KeyboardInterrupt):  # handlers are back
        os.kill(os.getpid(), signal.SIGINT)


def test_a_second_interruption_is_immediate() -> None:
    with Interruption() as interrupted:
        os.kill(os.getpid(), signal.SIGINT)
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)


class Failing(ToyEnv):
    """Its worker dies in the third round; or it answers NaN."""

    def __init__(self, num_envs: int, failure: str) -> None:
        super().__init__(num_envs)
        self._failure, self._rounds = failure, 0

    def reset(self, **arguments: Any) -> Any:
        self._rounds += 1
        return super().reset(**arguments)

    def step(self, actions: np.ndarray) -> Any:
        if self._rounds == 3 and self._failure == "dies":
            raise RuntimeError("worker 0 died")
        answer = super().step(actions)
        if self._rounds == 3:
            answer[4]["reward_distance"][1] = np.nan
        return answer


@pytest.mark.parametrize(
    ("failure", "message"), [("dies", "worker 0 died"), ("nan", r"components\[1, 0\] is nan")]
)
def test_failures_of_the_environment_end_the_run(
    tmp_path: Path, failure: str, message: str
) -> None:
    episodes = Episodes(Failing(4, failure), COMPONENTS, (), np.zeros(5, np.float32))
    config = replace(CONFIG, checkpoint_period=0.0)
    run = Training(Agent(SPACES, QUICK, 0), episodes, config)
    with pytest.raises((RuntimeError, ValueError), match=message):
        run.run(tmp_path)
    assert len(load_checkpoint(tmp_path).state["history"]) == 2


def test_diverging_losses_end_the_run() -> None:
    run = training(reward_weights={"distance": 1e30, "design": 1.0})
    with pytest.raises(LearningError, match="critics is inf"):
        run.run()


def test_mismatches_are_named_before_training() -> None:
    agent = Agent(Spaces(5, 2, 3), QUICK, 0)
    with pytest.raises(ValueError, match=r"actions have shape \(2,\)"):
        Training(agent, toy_episodes(2), CONFIG)
    agent = Agent(SPACES, QUICK, 0)
    other = ReplayBuffer(Spaces(5, 4, 2), COMPONENTS, 5)
    with pytest.raises(ValueError, match="demonstrations of"):
        Training(agent, toy_episodes(2), CONFIG, other)
    with pytest.raises(ValueError, match="reward weights"):
        Training(agent, toy_episodes(2), replace(CONFIG, reward_weights={"distance": 1.0}))
    env = ToyEnv(2)
    env.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
    with pytest.raises(ValueError, match="DISABLED"):
        Episodes(env, COMPONENTS, ())


def test_given_fingers_train_control_alone() -> None:
    """The design stage trimmed, as in fine-tuning: no design rows, the design actor untouched."""
    agent = Agent(SPACES, QUICK, 0)
    episodes = toy_episodes(8, two_stages=False)
    before = agent.actors["design"].mean.detach().clone()
    Training(agent, episodes, CONFIG).run()
    assert agent.updates == 30
    assert torch.equal(agent.actors["design"].mean, before)


def test_curves_for_tensorboard_without_repetition(tmp_path: Path) -> None:
    """A run that goes on from a checkpoint drops what was written after it."""
    begun = training(transitions=80)
    begun.run(tmp_path)
    with TensorBoardLog(tmp_path) as log:
        training(transitions=120).run(on_round=log)
    resumed = training()
    resumed.restore(load_checkpoint(tmp_path))
    with TensorBoardLog(tmp_path, transitions=80) as log:
        resumed.run(on_round=log)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    curve = [(e.step, e.value) for e in events.Scalars("round/return")]
    expected = [(row["transitions"], row["episode_return"]) for row in resumed.history]
    assert curve == [(step, pytest.approx(value)) for step, value in expected]
    assert "losses/critic_loss" in events.Tags()["scalars"]


def test_the_best_round_without_exploration_is_gone_back_to() -> None:
    agent = Agent(SPACES, replace(QUICK, mean_rounds=True), 0)
    run = Training(agent, toy_episodes(4), replace(CONFIG, transitions=400))
    played: list[tuple[float, torch.Tensor]] = []
    take = Agent.snapshot

    def snapshot(agent: Agent) -> torch.nn.Module:
        actor = take(agent)
        played.append((0.0, actor.layers[-1].bias.clone()))  # type: ignore[union-attr]
        return actor

    agent.snapshot = lambda: snapshot(agent)  # type: ignore[method-assign]
    run.run()
    assert len(run.history) == len(played)
    # Rounds take turns, once the actor has learned anything; only those without noise are judged.
    judged = [k for k in range(len(played)) if k % 2 == 0 and run.history[k - 1]["updates"] and k]
    best = max(judged, key=lambda k: run.history[k]["episode_return"])
    assert run.best_return == run.history[best]["episode_return"]
    run.recall_best()
    assert torch.equal(agent.averaged.layers[-1].bias, played[best][1])
    assert torch.equal(agent.actors["control"].layers[-1].bias, played[best][1])


def learned(updates_per_transition: float) -> tuple[Agent, Training]:
    """`fast` with smaller layers and batches, to save time, over 6,400 transitions.

    The first design (0, 0) costs 6.5 per episode. The control must reach targets that depend on the
    design: standing still costs 2.5, the best is 0.4.
    """
    preset = replace(
        TOY, hidden=(64, 64), batch_size=128, updates_per_transition=updates_per_transition
    )
    agent = Agent(SPACES, preset, 0)
    run = Training(agent, toy_episodes(16, terminates=True), TrainingConfig(6400, WEIGHTS))
    run.run()
    return agent, run


def centre_of(agent: Agent) -> np.ndarray:
    return torch.tanh(agent.actors["design"].mean).detach().numpy()  # type: ignore[operator]


def test_the_known_best_design_is_approached() -> None:
    """To one that costs less than a tenth of the first."""
    agent, run = learned(0.25)
    chosen = agent.choose_design(run.experience.designs, np.zeros(5)).design
    assert greedy(agent, centre_of(agent))[1] > -0.65
    assert greedy(agent, chosen)[1] > -6.5 / 2.0
    assert greedy(agent, np.zeros(2, np.float32))[1] == pytest.approx(-6.5)


def test_the_known_best_control_is_approached() -> None:
    """With twice the updates, with which the design actor walks on past the best design."""
    agent, _ = learned(0.5)
    distance, _ = greedy(agent, centre_of(agent))
    assert BEST_RETURN - 1.1 < distance < BEST_RETURN


def greedy(agent: Agent, design: np.ndarray) -> np.ndarray:
    """Returns without exploration, by component: distance and design."""
    store = ReplayBuffer(SPACES, COMPONENTS, 100)
    played = play_round(
        toy_episodes(8),
        99,
        lambda observation: agent.act(observation, explore=False),
        store,
        np.tile(design, (8, 1)),
    )
    return played.component_sums.mean(axis=0) * [WEIGHTS[name] for name in COMPONENTS]
