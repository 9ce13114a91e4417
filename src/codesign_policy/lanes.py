"""What every vector environment of the control stage shares: spaces, infos, seeds, fingers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair
from codesign_design.stock import stock_fingers
from codesign_policy.metrics import GraspMetrics
from codesign_policy.reward import RewardComponents

Lanes = NDArray[np.int_]
Info = dict[str, Any]
Step = tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]

# What a step's info and an ended episode's final info hold, (E,) each.
STEP_INFO: dict[str, type] = {
    **{f"reward_{f.name}": float for f in fields(RewardComponents)},
    "top10_stress": float,
    "mean_stress": float,
    "median_stress": float,
    "rise": float,
    "contact": bool,
    "success": bool,
    "penetration": float,
    "object_speed": float,
    "node_speed": float,
}
FINAL_INFO: dict[str, type] = {
    **{f.name: bool if f.name == "success" else float for f in fields(GraspMetrics)},
    "steps": int,
    "episode_seed": int,
}


def final_entries(
    mask: NDArray[np.bool_], observations: NDArray[np.float32], final: Mapping[str, NDArray]
) -> Info:
    """Gymnasium's entries of a step's info where `mask` says that episodes ended."""
    final_info: Info = {}
    for name, values in final.items():
        final_info[name], final_info[f"_{name}"] = (
            np.where(mask, values, values.dtype.type(0)),
            mask,
        )
    last = np.where(mask[:, None], observations, np.float32(0.0))
    return {
        "final_obs": last,
        "_final_obs": mask,
        "final_info": final_info,
        "_final_info": mask,
    }


def observation_size(fingers: Sequence[FingerPair]) -> int:
    """8 + D, for fingers with D design parameters each."""
    return 8 + len(fingers[0].parameters)


def observation_space(size: int) -> Box:
    """Normalised observations of one lane, (8 + D,): far beyond what a trial reaches.

    Tool and object within 2 m of the middle, the gap within 0.15 m, design parameters within 10.
    """
    high = np.concatenate([np.full(6, 20.0), [4.0, 1.0], np.full(size - 8, 10.0)])
    low = -high
    low[7] = 0.0
    return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def episode_seed(lane_seed: int, episode: int) -> int:
    """What `draw_domain` gets in a lane's n-th episode: the lane's seed itself in the first."""
    if episode == 0:
        return lane_seed
    return int(np.random.SeedSequence([lane_seed, episode]).generate_state(1)[0])


def per_lane(fingers: FingerPair | Sequence[FingerPair] | None, count: int) -> list[FingerPair]:
    """One pair for each lane; None stands for the stock fingers.

    Raises:
        ValueError: not as many pairs as lanes, or pairs that differ in their number of design
            parameters.
    """
    fingers = fingers or stock_fingers()
    pairs = [fingers] * count if isinstance(fingers, FingerPair) else list(fingers)
    if len(pairs) != count:
        raise ValueError(f"got {len(pairs)} finger pairs for {count} lanes: give one for each")
    designs = sorted({len(pair.parameters) for pair in pairs})
    if len(designs) > 1:
        raise ValueError(
            f"fingers have {designs} design parameters: give pairs of one design space"
        )
    return pairs


def check_options(options: Mapping[str, Any] | None, *known: str) -> Mapping[str, Any]:
    """The options of a reset, none for None; ValueError names those that are not known."""
    options = options or {}
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ValueError(f"reset options {unknown} are unknown: there are {list(known)}")
    return options


def check_swap(fingers: Mapping[int, FingerPair], lanes: Lanes) -> Mapping[int, FingerPair]:
    """New fingers by lane, all of them in lanes that are reset; ValueError otherwise."""
    stray = sorted(set(fingers) - set(lanes.tolist()))
    if stray:
        raise ValueError(f"fingers for lanes {stray}, which are not reset: mask them")
    return fingers


def swapped(fingers: Sequence[FingerPair], new: Mapping[int, FingerPair]) -> list[FingerPair]:
    """The fingers of all lanes with new ones in some.

    Raises:
        ValueError: the new ones have another number of design parameters.
    """
    pairs = per_lane([new.get(lane, pair) for lane, pair in enumerate(fingers)], len(fingers))
    if observation_size(pairs) != observation_size(fingers):
        raise ValueError(
            f"fingers with {len(pairs[0].parameters)} design parameters in place of "
            f"{len(fingers[0].parameters)}: make another environment for them"
        )
    return pairs


def set_spaces(env: Any) -> None:
    """Observation and action spaces of a vector environment with `fingers` in its lanes."""
    env.single_observation_space = observation_space(observation_size(env.fingers))
    env.single_action_space = Box(-1.0, 1.0, (7,), dtype=np.float32)
    env.observation_space = batch_space(env.single_observation_space, env.num_envs)
    env.action_space = batch_space(env.single_action_space, env.num_envs)
