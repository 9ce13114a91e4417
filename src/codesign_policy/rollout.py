"""Runs a policy in the lanes of a control environment and sums up what happened."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair
from codesign_policy.metrics import score
from codesign_policy.policy import Surroundings, load_policy
from codesign_policy.scripted import GraspPlan
from codesign_policy.task import Observation

Progress = Callable[[int, "Extremes"], None]


class LanePolicy(Protocol):
    """Acts in all lanes at once."""

    def restart(self, lanes: NDArray[np.bool_]) -> None:
        """Begins new episodes in the lanes marked True, (E,)."""

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float64]:
        """Actions (E, 7) in [-1, 1] that answer normalised observations (E, 8 + D)."""


class ScriptedLanes:
    """The scripted grasp in every lane."""

    def __init__(
        self, fingers: Sequence[FingerPair], plans: Sequence[GraspPlan] | None = None
    ) -> None:
        """Args: fingers and settings of the grasp of every lane. The table is at height 0."""
        self._policies = [
            load_policy("scripted", Surroundings(0.0, pair), plan)
            for pair, plan in zip(fingers, plans or [GraspPlan()] * len(fingers), strict=True)
        ]

    def restart(self, lanes: NDArray[np.bool_]) -> None:
        """The next observation of these lanes makes a new plan."""
        for lane in np.flatnonzero(lanes):
            self._policies[lane].reset()

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float64]:
        """Each lane's next action."""
        return np.stack(
            [
                policy.act(Observation.from_normalised(seen)).normalised()
                for policy, seen in zip(self._policies, observations, strict=True)
            ]
        )


class RandomLanes:
    """Uniformly random actions, each kept for some steps: the longer, the rougher."""

    def __init__(self, lanes: int, seed: int, hold: int = 1) -> None:
        """Args: number of lanes; seed; control steps that an action is kept, at least 1."""
        if hold < 1:
            raise ValueError(f"hold is {hold} control steps: use at least 1")
        self._random = np.random.default_rng(seed)
        self._lanes, self._hold, self._steps = lanes, hold, 0

    def restart(self, lanes: NDArray[np.bool_]) -> None:
        """Random actions know no episodes."""

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float64]:
        """Random actions, whatever is observed."""
        if self._steps % self._hold == 0:
            self._actions = self._random.uniform(-1.0, 1.0, (self._lanes, 7))
        self._steps += 1
        return self._actions


@dataclass
class Extremes:
    """The largest values seen at the end of any control step.

    Attributes:
        object_speed: of a block's centre of mass [m/s].
        node_speed: of a node of a block [m/s].
        top10_stress: [Pa].
        penetration: of a block into a finger [m].
    """

    object_speed: float = 0.0
    node_speed: float = 0.0
    top10_stress: float = 0.0
    penetration: float = 0.0

    def update(self, info: dict[str, Any]) -> None:
        """Takes in the info of a step."""
        for name in vars(self):
            setattr(self, name, max(getattr(self, name), float(info[name].max())))


@dataclass
class Rollout:
    """Outcome of `roll_out`.

    Attributes:
        steps: control steps, all lanes together.
        seconds: of wall time.
        extremes: the largest values of all steps.
        episodes: metrics of every episode that ended, (N,) each, by the names of `FINAL_INFO`.
    """

    steps: int = 0
    seconds: float = 0.0
    extremes: Extremes = field(default_factory=Extremes)
    episodes: dict[str, NDArray] = field(default_factory=dict)

    def summary(self) -> dict[str, float | int | None]:
        """Rates and means by name, units in the names; None where nothing was to be averaged."""
        success = self.episodes.get("success", np.zeros(0))
        top10 = self.episodes.get("top10_stress", np.zeros(0))
        rate = _statistic(np.mean, success)
        mean_top10 = _statistic(np.mean, top10)
        return {
            "episodes": len(success),
            "success_rate": rate,
            "top10_stress_pa": mean_top10,
            "top10_std_pa": _statistic(np.std, top10),
            "median_stress_pa": _statistic(np.mean, self.episodes.get("median_stress", success)),
            "median_std_pa": _statistic(np.std, self.episodes.get("median_stress", success)),
            "score": None if rate is None or mean_top10 is None else score(rate, mean_top10),
            "steps": self.steps,
            "seconds": self.seconds,
            "steps_per_second": self.steps / self.seconds,
            "fastest_object_m_s": self.extremes.object_speed,
            "fastest_node_m_s": self.extremes.node_speed,
            "highest_top10_stress_pa": self.extremes.top10_stress,
            "deepest_penetration_m": self.extremes.penetration,
        }


def roll_out(
    env: VectorEnv,
    policy: LanePolicy,
    *,
    seed: int = 0,
    steps: int | None = None,
    episodes: int | None = None,
    on_progress: Progress | None = None,
) -> Rollout:
    """Acts in an environment that restarts its lanes by itself (SAME_STEP).

    Args:
        env: a `ControlEnv` or `PooledControlEnv`.
        policy: for its lanes.
        seed: of the environment's reset.
        steps: control steps at least, all lanes together; or
        episodes: how many, the first that end, in the order of lanes.
        on_progress: called after every step of all lanes with the control steps so far.

    Raises:
        ValueError: both or none of steps and episodes, or a state that is not finite.
    """
    if (steps is None) == (episodes is None):
        raise ValueError("give either steps or episodes")
    result = Rollout()
    ended: list[dict[str, NDArray]] = []
    started = time.perf_counter()
    observations, _ = env.reset(seed=seed)
    policy.restart(np.ones(env.num_envs, dtype=bool))
    while result.steps < (steps or np.inf) and _count(ended) < (episodes or np.inf):
        observations, rewards, _, _, info = env.step(policy.act(observations))
        if not (np.isfinite(observations).all() and np.isfinite(rewards).all()):
            raise ValueError(f"not finite after {result.steps} steps: {observations}, {rewards}")
        result.steps += env.num_envs
        result.extremes.update(info)
        if "final_info" in info:
            over = info["_final_info"]
            ended.append({k: v[over] for k, v in info["final_info"].items() if k[0] != "_"})
            policy.restart(over)
        if on_progress is not None:
            on_progress(result.steps, result.extremes)
    result.seconds = time.perf_counter() - started
    if ended:
        result.episodes = {k: np.concatenate([e[k] for e in ended])[:episodes] for k in ended[0]}
    return result


def _count(ended: list[dict[str, NDArray]]) -> int:
    return sum(len(episode["success"]) for episode in ended)


def _statistic(of: Callable, values: NDArray) -> float | None:
    """Of the values that are numbers: stress is NaN where the tofu was never touched."""
    known = values[np.isfinite(values)] if values.dtype != bool else values
    return float(of(known)) if len(known) else None
