"""The loop on the real control stage: the two fit together, and a resumed run is the same run."""

from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from codesign_policy.checkpoint import load_checkpoint
from codesign_policy.control_env import ControlConfig, ControlEnv
from codesign_policy.presets import FAST
from codesign_policy.replay import Spaces
from codesign_policy.reward import RewardComponents, RewardWeights, weighted
from codesign_policy.rlpd import Agent
from codesign_policy.rounds import Episodes
from codesign_policy.tool import ToolStart
from codesign_policy.training import Training, TrainingConfig

COMPONENTS = tuple(field.name for field in fields(RewardComponents))
STEPS, LANES = 8, 4


def run(seed: int) -> Training:
    """Starts with the fingers around the block and nearly closed, so that it is squeezed."""
    near = ToolStart(position=(0.45, 0.0, 0.02), width=0.031)
    config = ControlConfig(episode_steps=STEPS, start=near)
    env = ControlEnv(LANES, config=config, autoreset_mode=AutoresetMode.DISABLED)
    episodes = Episodes(env, COMPONENTS, ("success", "peak_lift"))
    learner = {"hidden": (16,), "batch_size": 32, "design_rows": 4}
    preset = replace(FAST, start_transitions=LANES * STEPS, **learner)
    agent = Agent(Spaces(observation=8, design=0, control=7), preset, seed)
    budget = TrainingConfig(3 * LANES * STEPS, asdict(RewardWeights()), capacity=500)
    return Training(agent, episodes, budget)


def test_a_resumed_run_on_tofu_is_the_same_run(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    whole, begun, resumed = run(0), run(0), run(9)
    whole.run()
    begun.run(tmp_path, stop=lambda: True)
    resumed.restore(load_checkpoint(tmp_path))
    resumed.run()
    assert whole.agent.updates == 2 * LANES * STEPS // 4
    assert resumed.history == whole.history
    np.testing.assert_array_equal(
        resumed.experience.rows.observation, whole.experience.rows.observation
    )
    stress = whole.experience.rows.components[:, COMPONENTS.index("stress")]
    assert stress.min() < 0.0
    sums = [whole.experience.rows.components[:, k] for k in range(len(COMPONENTS))]
    rewards = weighted(RewardComponents(*map(np.float64, sums)), RewardWeights())
    np.testing.assert_allclose(whole.experience.reward(asdict(RewardWeights())), rewards, atol=1e-5)
