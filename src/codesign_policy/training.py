"""The training loop: designs, episodes, updates, round after round.

All lanes of a round start together from a seed that depends on the run's seed and the round alone.
Between rounds nothing is in flight, so that a checkpoint written there continues bit for bit; an
interruption waits for the end of its round.
"""

import csv
import io
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codesign_policy.checkpoint import (
    Checkpoint,
    random_state,
    require_same_configuration,
    restore_random,
    save_checkpoint,
)
from codesign_policy.files import write_text
from codesign_policy.proposals import ActorProposals, Proposer
from codesign_policy.replay import ReplayBuffer, sample_batch
from codesign_policy.rlpd import Agent
from codesign_policy.rounds import Array, Episodes, Played, play_round


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of a run besides the learner's.

    Attributes:
        transitions: of the control stage to gather in all; the last round may exceed it.
        reward_weights: of the reward's components.
        seed: of episodes, first random actions and batches.
        capacity: rows of experience that are kept.
        checkpoint_period: wall time between checkpoints [s].
    """

    transitions: int
    reward_weights: dict[str, float]
    seed: int = 0
    capacity: int = 500_000
    checkpoint_period: float = 60.0


@dataclass(frozen=True)
class Progress:
    """How far a run is after a round.

    Attributes:
        round: its number, from 1.
        transitions, budget: of the control stage so far, and in all.
        updates: of the critics so far.
        episode_return: undiscounted, mean over the lanes.
        metrics: means over the lanes that know them, such as success and stresses.
        losses: means over the round's updates; empty before the first one.
        designs, returns: of each lane, (E, D) and (E,).
        seconds: wall time of the round: "simulation", "updates" and "rest".
        seconds_left: until the budget is used up, at this round's pace.
    """

    round: int
    transitions: int
    budget: int
    updates: int
    episode_return: float
    metrics: dict[str, float]
    losses: dict[str, float]
    designs: Array | None
    returns: NDArray[np.float64]
    seconds: dict[str, float]
    seconds_left: float

    def row(self) -> dict[str, float]:
        """What the run's history keeps of it."""
        plain = ("round", "transitions", "updates", "episode_return")
        return {**{name: getattr(self, name) for name in plain}, **self.metrics, **self.losses}


class Training:
    """One run: an agent, its environment, demonstrations and experience.

    Attributes:
        experience: what was gathered online.
        history: one row per round.
        proposer: of designs; None where there is no design stage.
        best_return: the highest mean return of a round without exploration.
    """

    def __init__(
        self,
        agent: Agent,
        episodes: Episodes,
        config: TrainingConfig,
        demonstrations: ReplayBuffer | None = None,
        proposer: Proposer | None = None,
    ) -> None:
        """
        Args:
            agent: learns. One that has learned before acts at once; a new one acts at random
                until the preset's first updates.
            episodes: where experience comes from.
            config: settings.
            demonstrations: half of every batch; None: a pure online run.
            proposer: of designs, where there is a design stage; None: the agent's design actor.

        Raises:
            ValueError: sizes, reward components or weights that do not belong together.
        """
        episodes.require(agent.spaces)
        self.agent, self.episodes, self.config = agent, episodes, config
        self.demonstrations = demonstrations
        self.experience = ReplayBuffer(agent.spaces, episodes.components, config.capacity)
        for buffer in self._buffers:
            if buffer.spaces != agent.spaces:
                raise ValueError(f"demonstrations of {buffer.spaces}: the agent has {agent.spaces}")
            buffer.reward(config.reward_weights)
        self.history: list[dict[str, float]] = []
        self.proposer = proposer or self._actor_proposals()
        self._random = np.random.default_rng([config.seed, 1])
        self._rounds = self._transitions = self._updates = 0
        self.best_return = -np.inf

    @property
    def transitions(self) -> int:
        """Of the control stage so far."""
        return self._transitions

    @property
    def done(self) -> bool:
        """Whether the budget is used up."""
        return self._transitions >= self.config.transitions

    def clone_demonstrations(self) -> None:
        """Starts the control actor from them, where there are any: before the first round.

        Raises:
            LearningError: the regression went astray.
        """
        if self.demonstrations is None or not self.agent.preset.cloning:
            return
        rows = self.demonstrations.rows
        control = rows.pick(rows.in_control)
        self.agent.clone(control.observation, control.action[:, self.agent.spaces.design :])

    def recall_best(self) -> None:
        """Goes back to the controller of the best round without exploration, if there was one.

        Learning has its ups and downs; who is served last should not depend on where it stopped.
        """
        if self.best_return > -np.inf:
            self.agent.recall()

    def run(
        self,
        folder: Path | None = None,
        on_round: Callable[[Progress], None] = lambda progress: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Trains until the budget is used up, or `stop()` is true after a round.

        Args:
            folder: where checkpoints go, now and then and at the end; None: nowhere.
            on_round: called after every round.
            stop: asked after every round, such as an `Interruption`.

        Raises:
            LearningError: a loss that is not finite; the last checkpoint stays.
            ValueError: the environment answered with wrong shapes or numbers; likewise.
        """
        saved = time.monotonic()
        while not self.done:
            progress = self._round()
            self.history.append(progress.row())
            on_round(progress)
            if stop():
                break
            if folder and time.monotonic() - saved > self.config.checkpoint_period:
                self.save(folder)
                saved = time.monotonic()
        if folder:
            self.save(folder)

    def act(self, observation: Array) -> Array:
        """The policy's mean actions (n, 7) for observations (n, o)."""
        return self.agent.act(observation, explore=False)

    # ---------------------------------------------------------------- a round

    @property
    def _buffers(self) -> list[ReplayBuffer]:
        return [b for b in (self.demonstrations, self.experience) if b is not None]

    def _round(self) -> Progress:
        began = time.perf_counter()
        learning = 0.0
        losses: dict[str, list[float]] = defaultdict(list)

        def learn(stored: int) -> None:
            nonlocal learning
            start = time.perf_counter()
            self._transitions += stored
            self._learn(losses)
            learning += time.perf_counter() - start

        designs = self.proposer.propose() if self.proposer else None
        seed = np.random.SeedSequence([self.config.seed, self._rounds]).generate_state(1)[0]
        explores = self._explores
        snapshot = self.agent.snapshot()  # learning goes on while it plays

        def act(observation: Array) -> Array:
            if explores:
                return self._explore(observation)
            return self.agent.act(observation, explore=False, snapshot=snapshot)

        played = play_round(self.episodes, int(seed % 2**31), act, self.experience, designs, learn)
        if self.proposer and not explores:
            self.proposer.judge(played.metrics)
        self._rounds += 1
        total = time.perf_counter() - began
        seconds = {"simulation": played.simulation_seconds, "updates": learning}
        seconds["rest"] = total - sum(seconds.values())
        progress = self._progress(played, losses, designs, seconds)
        if not explores and progress.episode_return > self.best_return:
            self.best_return = progress.episode_return
            self.agent.remember(snapshot)
        return progress

    def _actor_proposals(self) -> Proposer | None:
        observation = self.episodes.design_observation
        if observation is None:
            return None
        return ActorProposals(self.agent, observation, self.episodes.environment.num_envs)

    @property
    def _explores(self) -> bool:
        """Whether the coming round does; others are played as the policy will be served.

        These show designs at their best: with noise a grasp at its edge slips.
        """
        mean_rounds = self.agent.preset.mean_rounds and self.agent.acts
        return bool(self._rounds % 2) or not mean_rounds

    def _explore(self, observation: Array) -> Array:
        if self.agent.acts:
            return self.agent.act(observation, explore=True)
        shape = (len(observation), self.agent.spaces.control)
        return self._random.uniform(-1.0, 1.0, shape).astype(np.float32)

    def _learn(self, losses: dict[str, list[float]]) -> None:
        """The updates that are due for the transitions so far."""
        preset = self.agent.preset
        due = int((self._transitions - preset.start_transitions) * preset.updates_per_transition)
        while self._updates < due:
            batch = sample_batch(
                self._buffers,
                preset.batch_size,
                preset.design_rows,
                self.config.reward_weights,
                self._random,
            )
            for name, value in self.agent.update(batch).items():
                losses[name].append(value)
            self._updates += 1

    def _progress(
        self,
        played: Played,
        losses: dict[str, list[float]],
        designs: Array | None,
        seconds: dict[str, float],
    ) -> Progress:
        weights = [self.config.reward_weights[name] for name in self.episodes.components]
        returns = played.component_sums @ np.array(weights)
        known = {name: values[~np.isnan(values)] for name, values in played.metrics.items()}
        left = max(0, self.config.transitions - self._transitions)
        return Progress(
            round=self._rounds,
            transitions=self._transitions,
            budget=self.config.transitions,
            updates=self._updates,
            episode_return=float(returns.mean()),
            metrics={name: float(values.mean()) for name, values in known.items() if len(values)},
            losses={name: float(np.mean(values)) for name, values in losses.items()},
            designs=designs,
            returns=returns,
            seconds=seconds,
            seconds_left=left * sum(seconds.values()) / played.transitions,
        )

    # ----------------------------------------------------------- checkpoints

    def save(self, folder: Path) -> None:
        """Writes a checkpoint and the history as a table (history.csv); call between rounds."""
        demonstrations = self.demonstrations
        state = {
            "agent": self.agent.state(),
            "experience": self.experience.state(),
            "demonstrations": demonstrations.state() if demonstrations is not None else None,
            "proposer": self.proposer.state() if self.proposer else {},
            "random": random_state(self._random),
            "counts": [self._rounds, self._transitions, self._updates],
            "best_return": self.best_return,
            "history": self.history,
        }
        save_checkpoint(folder, state, self.configuration())
        write_text(folder / "history.csv", _table(self.history))

    def restore(self, checkpoint: Checkpoint) -> None:
        """Goes on where a run was saved; demonstrations become those of the checkpoint.

        Budget and checkpoint period may differ, everything else must be as it was.

        Raises:
            ValueError: other settings or shapes than those of the checkpoint; names the first.
        """
        mine = self.configuration()
        free = {name: mine["training"][name] for name in ("transitions", "checkpoint_period")}
        stored = checkpoint.configuration
        stored = {**stored, "training": {**stored["training"], **free}}
        require_same_configuration(stored, mine)
        state = checkpoint.state
        self.agent.restore(state["agent"])
        self.experience.restore(state["experience"])
        if self.demonstrations is not None:
            self.demonstrations.restore(state["demonstrations"])
        if self.proposer:
            self.proposer.restore(state["proposer"])
        restore_random(self._random, state["random"])
        self._rounds, self._transitions, self._updates = state["counts"]
        self.best_return = state["best_return"]
        self.history = list(state["history"])

    def configuration(self) -> dict[str, Any]:
        """What this run was made with, as plain values."""
        demonstrations = self.demonstrations
        return {
            "preset": asdict(self.agent.preset),
            "spaces": asdict(self.agent.spaces),
            "training": asdict(self.config),
            "lanes": self.episodes.environment.num_envs,
            "two_stages": self.episodes.design_observation is not None,
            "demonstrations": 0 if demonstrations is None else demonstrations.capacity,
        }


def _table(history: list[dict[str, float]]) -> str:
    """The history as CSV; what a round did not know is empty."""
    text = io.StringIO()
    columns = dict.fromkeys(name for row in history for name in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(history)
    return text.getvalue()
