"""How well a trained pair does, with intervals: the paper's metrics over many episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, bootstrap

from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.metrics import score
from codesign_policy.policy_file import TrainedPair
from codesign_policy.rollout import Extremes, Rollout, roll_out
from codesign_policy.run import fingers_of

LANES = 8
CONFIDENCE = 0.95

Interval = tuple[float, float]


@dataclass(frozen=True)
class Evaluation:
    """Outcome of `evaluate`; field names carry units.

    Attributes:
        success_rate: share of episodes; its interval is Clopper and Pearson's.
        top10_stress_pa, median_stress_pa: means over the episodes in which the fingers touched the
            block, each averaged over the interaction period; intervals by bootstrap (BCa).
        top10_std, median_std: over these episodes [Pa].
        score: equation 2.
        episodes, tetrahedra, friction, pose_error_m, seed: what was asked for.
    """

    success_rate: float
    top10_stress_pa: float | None
    median_stress_pa: float | None
    top10_std: float | None
    median_std: float | None
    score: float
    episodes: int
    success_interval: Interval
    top10_interval: Interval | None
    median_interval: Interval | None
    tetrahedra: int
    friction: Interval
    pose_error_m: float
    seed: int

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


class LearnedLanes:
    """A trained pair's mean action in every lane."""

    def __init__(self, pair: TrainedPair) -> None:
        self._pair = pair

    def restart(self, lanes: NDArray[np.bool_]) -> None:
        """It remembers nothing."""

    def act(self, observations: NDArray[np.float32]) -> NDArray[np.float64]:
        """Each lane's next action."""
        return self._pair.act(observations).astype(np.float64)


def evaluate(
    pair: TrainedPair,
    episodes: int,
    config: ControlConfig,
    seed: int = 0,
    on_progress: Callable[[int, Extremes], None] | None = None,
) -> Evaluation:
    """Plays episodes with the pair's own fingers; episode i is the trial of seed + i, i < 8.

    Args:
        pair: to be judged.
        episodes: at least 2.
        config: of the control stage.
        seed: of the first lane.
        on_progress: told the control steps so far.

    Raises:
        ValueError: fewer than 2 episodes, or fingers that cannot be made.
    """
    if episodes < 2:
        raise ValueError(f"{episodes} episodes: intervals need at least 2")
    env = ControlEnv(LANES, fingers_of(pair.space, pair.design), config)
    try:
        played = roll_out(
            env, LearnedLanes(pair), seed=seed, episodes=episodes, on_progress=on_progress
        )
    finally:
        env.close()
    return _summed_up(played, config, seed)


def _summed_up(played: Rollout, config: ControlConfig, seed: int) -> Evaluation:
    success = played.episodes["success"].astype(bool)
    top10, median = (
        values[np.isfinite(values)]
        for values in (played.episodes["top10_stress"], played.episodes["median_stress"])
    )
    sure = binomtest(int(success.sum()), len(success)).proportion_ci(CONFIDENCE)
    rate = float(success.mean())
    mean_top10 = float(top10.mean()) if len(top10) else None
    return Evaluation(
        success_rate=rate,
        top10_stress_pa=mean_top10,
        median_stress_pa=float(median.mean()) if len(median) else None,
        top10_std=float(top10.std()) if len(top10) else None,
        median_std=float(median.std()) if len(median) else None,
        score=score(rate, float("nan") if mean_top10 is None else mean_top10),
        episodes=len(success),
        success_interval=(float(sure.low), float(sure.high)),
        top10_interval=mean_interval(top10),
        median_interval=mean_interval(median),
        tetrahedra=config.tetrahedra,
        friction=config.friction,
        pose_error_m=config.pose_error,
        seed=seed,
    )


def mean_interval(values: NDArray[np.floating]) -> Interval | None:
    """95 % bootstrap interval (BCa) of the mean; None for fewer than two different values."""
    if len(values) < 2 or np.ptp(values) == 0.0:
        return None
    random = np.random.default_rng(0)
    found = bootstrap((values,), np.mean, confidence_level=CONFIDENCE, rng=random)
    return float(found.confidence_interval.low), float(found.confidence_interval.high)
