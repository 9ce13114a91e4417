"""Demonstrations of control alone: with given fingers, by the expert or by a trained policy."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.domain import FRICTION
from codesign_policy.expert_plan import DemonstrationError, best_plan
from codesign_policy.reactive import ReactiveLanes
from codesign_policy.replay import ReplayBuffer, Transitions, joined
from codesign_policy.rlpd import Agent
from codesign_policy.rounds import Episodes, play_round
from codesign_policy.run import RunConfig, fingers_of, make_episodes

FINE = 2400  # tetrahedra
SHOWN = 3  # episodes, as many as there are demonstrated designs: 600 transitions


def expert_rows(config: RunConfig, episodes: int = SHOWN) -> ReplayBuffer:
    """Grasps of the expert with the run's fingers that succeed, at the gap that suits them best.

    Args:
        config: the run's; block, friction and error of the pose are drawn as in it.
        episodes: that are played, from the run's seed up.

    Raises:
        DemonstrationError: none succeeds, or fingers that the expert cannot use.
        ValueError: a design that cannot be used.
    """
    shown = _expert_episodes(config, episodes)
    if not shown:
        raise DemonstrationError(f"none of {episodes} grasps of the expert succeeds")
    return _together(config, shown)


def nominal_rows(config: RunConfig) -> ReplayBuffer:
    """`expert_rows` under the conditions of demonstrated designs: friction 0.5, no error, fine."""
    nominal = replace(config, tetrahedra=FINE, friction=(FRICTION, FRICTION), pose_error=0.0)
    return expert_rows(nominal)


def own_rows(agent: Agent, config: RunConfig) -> ReplayBuffer:
    """Pseudo-demonstrations (paper, III-D): the policy's episodes that succeed, one per lane.

    Raises:
        DemonstrationError: none does.
    """
    return _together(config, _own_episodes(agent, config))


def gentlest_rows(agent: Agent, config: RunConfig) -> ReplayBuffer:
    """Of the policy's and the expert's episodes with these fingers the half with the least stress.

    Where the expert cannot use the fingers, the policy's own alone.

    Raises:
        DemonstrationError: no episode of the policy succeeds.
    """
    played = _own_episodes(agent, config)
    try:
        played += _expert_episodes(config, config.lanes)
    except DemonstrationError:
        return _together(config, played)
    played.sort(key=lambda episode: episode.stress)
    return _together(config, played[: (len(played) + 1) // 2])


@dataclass(frozen=True)
class _Episode:
    """One that succeeded: its rows, and top-10 % and median stress [Pa] added."""

    rows: Transitions
    stress: float


def _expert_episodes(config: RunConfig, episodes: int) -> list[_Episode]:
    fingers = fingers_of(config.space, config.design)
    plan, _ = best_plan(fingers, config.tetrahedra, config.seed)
    expert = ReactiveLanes([fingers] * episodes, [plan] * episodes)
    return _played(config, make_episodes(config, episodes), expert.act)


def _own_episodes(agent: Agent, config: RunConfig) -> list[_Episode]:
    played = _played(config, make_episodes(config), lambda seen: agent.act(seen, explore=False))
    if not played:
        raise DemonstrationError(
            f"none of {config.lanes} episodes of the policy succeeds at {config.tetrahedra} "
            "tetrahedra: train it longer first"
        )
    return played


def _played(
    config: RunConfig, episodes: Episodes, act: Callable[[NDArray[np.float32]], NDArray[np.float32]]
) -> list[_Episode]:
    """One episode in every lane, of which those that succeed."""
    lanes = episodes.environment.num_envs
    rows = ReplayBuffer(config.spaces, COMPONENTS, lanes * config.control().episode_steps)
    metrics = play_round(episodes, config.seed, act, rows).metrics
    stress = metrics["top10_stress"] + metrics["median_stress"]
    lane_of_row = np.arange(len(rows)) % lanes  # lanes take turns in rows
    return [
        _Episode(rows.rows.pick(lane_of_row == lane), float(stress[lane]))
        for lane in np.flatnonzero(metrics["success"])
    ]


def _together(config: RunConfig, episodes: Sequence[_Episode]) -> ReplayBuffer:
    empty = ReplayBuffer(config.spaces, COMPONENTS, 1)
    return joined(empty, *(episode.rows for episode in episodes))
