"""A two-stage task with a known optimum: a point must go where its design points to.

A design x in [-1, 1]^2 places a target at distance 0.5 from the start, in direction pi/2 x_0. The
point moves by 0.2 a per step. Each step costs the distance to the target and 10 |x - BEST|^2 for
the design. All targets are equally far away, so the best design is BEST exactly.
"""

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from codesign_policy.replay import Spaces
from codesign_policy.rounds import Episodes

BEST = np.array([0.3, -0.2])
STEPS = 5
SPACES = Spaces(observation=5, design=2, control=2)  # point, f, design
COMPONENTS = ("distance", "design")
WEIGHTS = {"distance": 1.0, "design": 10.0}
# 0.3 + 0.1 while two steps of 0.2 bring the point near, then nothing.
BEST_RETURN = -0.4


class ToyEnv(VectorEnv):
    """Observation [point, f = 1, design]; after STEPS an episode is truncated, or terminated."""

    metadata = {"autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012

    def __init__(self, num_envs: int, *, terminates: bool = False) -> None:
        self.num_envs, self._terminates = num_envs, terminates
        self.single_observation_space = Box(-np.inf, np.inf, (5,), np.float32)
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._designs = np.zeros((num_envs, 2))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        random = np.random.default_rng(seed)
        if options:
            self._designs = np.asarray(options["designs"], np.float64)
        self._points = random.normal(0.0, 0.01, (self.num_envs, 2))
        self._steps = 0
        return self._observations(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any, Any, dict[str, Any]]:
        self._points = self._points + 0.2 * actions
        self._steps += 1
        distance = np.linalg.norm(self._points - self.targets(), axis=1)
        info: dict[str, Any] = {
            "reward_distance": -distance,
            "reward_design": -((self._designs - BEST) ** 2).sum(axis=1),
        }
        last = np.full(self.num_envs, self._steps >= STEPS)
        if last.any():
            info["final_info"] = {"success": distance < 0.05}
        reward = sum(WEIGHTS[name] * info[f"reward_{name}"] for name in COMPONENTS)
        no = np.zeros_like(last)
        ends = (last, no) if self._terminates else (no, last)
        return self._observations(), reward, *ends, info

    def targets(self) -> np.ndarray:
        angle = np.pi / 2.0 * self._designs[:, 0]
        return 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def _observations(self) -> np.ndarray:
        flag = np.ones((self.num_envs, 1))
        return np.concatenate([self._points, flag, self._designs], axis=1).astype(np.float32)


def toy_episodes(lanes: int, *, two_stages: bool = True, terminates: bool = False) -> Episodes:
    """The task with, or without, its design stage."""
    design_observation = np.zeros(5, np.float32) if two_stages else None
    env = ToyEnv(lanes, terminates=terminates)
    return Episodes(env, COMPONENTS, ("success",), design_observation)
