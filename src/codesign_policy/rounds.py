"""Rounds: one episode in every lane of an environment, stored as transitions of both stages."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from codesign_policy.replay import ReplayBuffer, Spaces, Transitions

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Episodes:
    """An environment, and what must be known about it to learn from it.

    Attributes:
        environment: a Gymnasium vector environment of the control stage that does not reset by
            itself (`AutoresetMode.DISABLED`) and gives equal bits for equal seeds and actions.
            Every step's info holds the reward's components as "reward_<name>", (E,); where lanes
            end, "final_info" holds their metrics by name, (E,).
        components: names of the reward's components.
        metrics: names of the final metrics to keep.
        design_observation: o_D, (o,), what the design stage sees. The designs of a round, (E, D)
            in [-1, 1], are then handed to `reset(options={"designs": ...})`. None: fingers are
            given and there is only the control stage.
    """

    environment: VectorEnv
    components: tuple[str, ...]
    metrics: tuple[str, ...]
    design_observation: Array | None = None

    def __post_init__(self) -> None:
        mode = self.environment.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.DISABLED:
            raise ValueError(f"environment with autoreset mode {mode}: make one with DISABLED")

    def require(self, spaces: Spaces) -> None:
        """Raises: ValueError: the environment is not of these sizes."""
        o_d = self.design_observation
        shapes = {
            "observations": (self.environment.single_observation_space.shape, spaces.observation),
            "actions": (self.environment.single_action_space.shape, spaces.control),
            "design observations": (
                (spaces.observation,) if o_d is None else o_d.shape,
                spaces.observation,
            ),
        }
        for what, (shape, size) in shapes.items():
            if shape != (size,):
                raise ValueError(f"{what} have shape {shape}: the agent was made for ({size},)")
        if o_d is not None and not spaces.design:
            raise ValueError("the environment has a design stage: the agent has no design numbers")


@dataclass(frozen=True)
class Played:
    """What a round brought.

    Attributes:
        component_sums: sums of each component over each lane's episode, (E, K).
        metrics: final metrics by name, (E,) each; NaN where a lane does not know one.
        transitions: of the control stage.
        simulation_seconds: wall time spent in the environment.
    """

    component_sums: NDArray[np.float64]
    metrics: dict[str, NDArray[np.float64]]
    transitions: int
    simulation_seconds: float


def play_round(
    episodes: Episodes,
    seed: int,
    act: Callable[[Array], Array],
    store: ReplayBuffer,
    designs: Array | None = None,
    after_step: Callable[[int], None] = lambda stored: None,
) -> Played:
    """Plays one episode in every lane and stores its transitions.

    Args:
        episodes: where.
        seed: of the environment's reset.
        act: control actions (E, 7) for observations (E, o); those of lanes that have ended are
            ignored.
        store: takes the transitions of both stages.
        designs: (E, D) in [-1, 1], where there is a design stage.
        after_step: called after every control step with the number of transitions it stored.

    Raises:
        ValueError: the environment answered with wrong shapes, or numbers that are not finite.
    """
    environment, lanes = episodes.environment, episodes.environment.num_envs
    options = None if designs is None else {"designs": designs}
    began = time.perf_counter()
    observation, _ = environment.reset(seed=seed, options=options)
    simulation = time.perf_counter() - began
    if designs is not None:
        store.insert(_design_rows(episodes, designs, observation))
    active, sums = np.ones(lanes, dtype=bool), np.zeros((lanes, len(episodes.components)))
    metrics = {name: np.full(lanes, np.nan) for name in episodes.metrics}
    transitions = 0
    while active.any():
        controls = act(observation)
        began = time.perf_counter()
        following, _, terminated, truncated, info = environment.step(controls)
        simulation += time.perf_counter() - began
        components = np.stack([info[f"reward_{name}"] for name in episodes.components], axis=1)
        rows = Transitions(
            observation=observation,
            action=np.pad(controls, ((0, 0), (store.spaces.design, 0))),
            in_control=np.ones(lanes, dtype=bool),
            components=components,
            next_observation=following,
            terminated=terminated,
            truncated=truncated,
        ).pick(active)
        store.insert(rows)
        sums[active] += components[active]
        transitions += len(rows.in_control)
        ending = active & (terminated | truncated)
        if ending.any():
            for name, values in metrics.items():
                values[ending] = info["final_info"][name][ending]
        active, observation = active & ~ending, following
        after_step(len(rows.in_control))
    return Played(sums, metrics, transitions, simulation)


def _design_rows(episodes: Episodes, designs: Array, first: Array) -> Transitions:
    """The design stage's transitions: from o_D by the design to the first control observation."""
    assert episodes.design_observation is not None
    count, control = len(designs), episodes.environment.single_action_space.shape
    assert control is not None
    no = np.zeros(count, dtype=bool)
    return Transitions(
        observation=np.tile(episodes.design_observation, (count, 1)),
        action=np.pad(designs, ((0, 0), (0, control[0]))),
        in_control=no,
        components=np.zeros((count, len(episodes.components)), np.float32),
        next_observation=first,
        terminated=no,
        truncated=no,
    )
