"""One lane of the control stage as a Gymnasium environment, and both under their names.

import codesign_policy.tofu_grasp
env = gymnasium.make("codesign/TofuGrasp-v0")
lanes = gymnasium.make_vec("codesign/TofuGrasp-v0", 8, vectorization_mode="vector_entry_point")
"""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.lanes import STEP_INFO

ID = "codesign/TofuGrasp-v0"


class TofuGrasp(gymnasium.Env):
    """A single lane; an episode's metrics are in the info of its last step."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self, fingers: FingerPair | None = None, config: ControlConfig | None = None
    ) -> None:
        """Args: fingers, None for the stock ones; settings."""
        self._lanes = ControlEnv(1, fingers, config, AutoresetMode.DISABLED)
        self.observation_space = self._lanes.single_observation_space
        self.action_space = self._lanes.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Starts a new episode, as `ControlEnv.reset`."""
        super().reset(seed=seed)
        observations, info = self._lanes.reset(seed=seed)
        return observations[0], {"episode_seed": int(info["episode_seed"][0])}

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One control step, as `ControlEnv.step`."""
        observations, rewards, terminated, truncated, info = self._lanes.step(action[None])
        own = {name: info[name][0].item() for name in STEP_INFO}
        if "final_info" in info:
            final = info["final_info"]
            own["final_info"] = {n: v[0].item() for n, v in final.items() if n[0] != "_"}
        return observations[0], float(rewards[0]), bool(terminated[0]), bool(truncated[0]), own


gymnasium.register(
    ID,
    entry_point="codesign_policy.tofu_grasp:TofuGrasp",
    vector_entry_point="codesign_policy.control_env:ControlEnv",
)
