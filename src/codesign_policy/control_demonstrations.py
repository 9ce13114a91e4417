"""Demonstrations of control alone: with given fingers, by the script or by a trained policy."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.domain import FRICTION
from codesign_policy.expert_demonstrations import SETTLE_TIME, DemonstrationError
from codesign_policy.finger_plan import plan_for
from codesign_policy.replay import ReplayBuffer, Transitions
from codesign_policy.rlpd import Agent
from codesign_policy.rollout import ScriptedLanes
from codesign_policy.rounds import Episodes, play_round
from codesign_policy.run import RunConfig, fingers_of, make_episodes

SCRIPTED = 3  # episodes, as many as there are demonstrated designs: 600 transitions


def scripted_rows(config: RunConfig) -> ReplayBuffer:
    """Scripted grasps with the run's fingers, seeds 0, 1, 2, at the friction they are planned for.

    Raises:
        DemonstrationError: one of them fails.
        ValueError: the run's fingers do not allow the script.
    """
    fingers = fingers_of(config.space, config.design)
    plan = replace(plan_for(fingers), settle_time=SETTLE_TIME)
    # On a coarse block, and seen where it is: what is demonstrated is the motion.
    simple = replace(config, tetrahedra=600, friction=(FRICTION, FRICTION), pose_error=0.0)
    episodes = make_episodes(simple, SCRIPTED)
    script = ScriptedLanes([fingers] * SCRIPTED, [plan] * SCRIPTED)
    rows, success = _played(config, episodes, script.act, seed=0)  # type: ignore[arg-type]
    if not success.all():
        raise DemonstrationError(
            f"scripted grasps with {fingers.name!r}: {int(success.sum())} of {SCRIPTED} succeed"
        )
    return rows


def own_rows(agent: Agent, config: RunConfig) -> ReplayBuffer:
    """Pseudo-demonstrations (paper, III-D): the policy's episodes that succeed, one per lane.

    Raises:
        DemonstrationError: none does.
    """
    rows, success = _played(
        config, make_episodes(config), lambda seen: agent.act(seen, explore=False), config.seed
    )
    if not success.any():
        raise DemonstrationError(
            f"none of {config.lanes} episodes of the policy succeeds at {config.tetrahedra} "
            "tetrahedra: train it longer first"
        )
    kept = np.flatnonzero(success[np.arange(len(rows)) % config.lanes])  # lanes take turns in rows
    return _copy(rows, rows.rows.pick(kept))


def _played(
    config: RunConfig,
    episodes: Episodes,
    act: Callable[[NDArray[np.float32]], NDArray[np.float32]],
    seed: int,
) -> tuple[ReplayBuffer, NDArray[np.bool_]]:
    """One episode in every lane: its rows, and which lanes succeeded."""
    lanes = episodes.environment.num_envs
    rows = ReplayBuffer(config.spaces, COMPONENTS, lanes * config.control().episode_steps)
    played = play_round(episodes, seed, act, rows)
    return rows, played.metrics["success"].astype(bool)


def _copy(rows: ReplayBuffer, kept: Transitions) -> ReplayBuffer:
    buffer = ReplayBuffer(rows.spaces, rows.components, len(kept.in_control))
    buffer.insert(kept)
    return buffer
