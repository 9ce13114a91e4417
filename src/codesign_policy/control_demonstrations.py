"""Demonstrations of control alone: with given fingers, by the expert or by a trained policy."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.domain import FRICTION
from codesign_policy.expert_plan import DemonstrationError, best_plan
from codesign_policy.reactive import ReactiveLanes
from codesign_policy.replay import ReplayBuffer, Transitions
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
    fingers = fingers_of(config.space, config.design)
    plan, _ = best_plan(fingers, config.tetrahedra, config.seed)
    expert = ReactiveLanes([fingers] * episodes, [plan] * episodes)
    rows, success = _played(config, make_episodes(config, episodes), expert.act)
    if not success.any():
        raise DemonstrationError(f"none of {episodes} grasps with {fingers.name!r} succeeds")
    return _copy(rows, _kept(rows, success))


def nominal_rows(config: RunConfig) -> ReplayBuffer:
    """`expert_rows` under the conditions of demonstrated designs: friction 0.5, no error, fine."""
    nominal = replace(config, tetrahedra=FINE, friction=(FRICTION, FRICTION), pose_error=0.0)
    return expert_rows(nominal)


def own_rows(agent: Agent, config: RunConfig) -> ReplayBuffer:
    """Pseudo-demonstrations (paper, III-D): the policy's episodes that succeed, one per lane.

    Raises:
        DemonstrationError: none does.
    """
    rows, success = _played(
        config, make_episodes(config), lambda seen: agent.act(seen, explore=False)
    )
    if not success.any():
        raise DemonstrationError(
            f"none of {config.lanes} episodes of the policy succeeds at {config.tetrahedra} "
            "tetrahedra: train it longer first"
        )
    return _copy(rows, _kept(rows, success))


def fine_tuning_rows(agent: Agent, config: RunConfig) -> ReplayBuffer:
    """Pseudo-demonstrations of the policy, and as many grasps of the expert with these fingers.

    Where the expert cannot use the fingers, the policy's own alone.

    Raises:
        DemonstrationError: no episode of the policy succeeds.
    """
    own = own_rows(agent, config)
    try:
        shown = expert_rows(config, config.lanes)
    except DemonstrationError:
        return own
    return _copy(own, own.rows, shown.rows)


def _played(
    config: RunConfig,
    episodes: Episodes,
    act: Callable[[NDArray[np.float32]], NDArray[np.float32]],
) -> tuple[ReplayBuffer, NDArray[np.bool_]]:
    """One episode in every lane: its rows, and which lanes succeeded."""
    lanes = episodes.environment.num_envs
    rows = ReplayBuffer(config.spaces, COMPONENTS, lanes * config.control().episode_steps)
    played = play_round(episodes, config.seed, act, rows)
    return rows, played.metrics["success"].astype(bool)


def _kept(rows: ReplayBuffer, success: NDArray[np.bool_]) -> Transitions:
    """Rows of the lanes that succeeded; lanes take turns in rows."""
    return rows.rows.pick(np.flatnonzero(success[np.arange(len(rows)) % len(success)]))


def _copy(like: ReplayBuffer, *parts: Transitions) -> ReplayBuffer:
    buffer = ReplayBuffer(like.spaces, like.components, sum(len(p.in_control) for p in parts))
    for part in parts:
        buffer.insert(part)
    return buffer
