"""Behaviour cloning of demonstrations with a known rule."""

from dataclasses import replace

import numpy as np
import torch

from codesign_policy.cloning import SPREAD, clone
from codesign_policy.presets import FAST
from codesign_policy.replay import ReplayBuffer, Spaces, Transitions
from codesign_policy.rlpd import Agent

SPACES = Spaces(observation=10, design=2, control=7)


def shown(count: int = 200) -> ReplayBuffer:
    """a = o / 2 of the first seven numbers; every tenth row is of the design stage."""
    random = np.random.default_rng(0)
    observation = random.uniform(-1.0, 1.0, (count, 10)).astype(np.float32)
    no = np.zeros(count, dtype=bool)
    rows = ReplayBuffer(SPACES, ("r",), count)
    rows.insert(
        Transitions(
            observation=observation,
            action=np.concatenate([np.zeros((count, 2)), 0.5 * observation[:, :7]], axis=1),
            in_control=np.arange(count) % 10 != 0,
            components=np.zeros((count, 1)),
            next_observation=observation,
            terminated=no,
            truncated=no,
        )
    )
    return rows


def test_the_rule_is_learned_and_nothing_else_changes() -> None:
    torch.set_num_threads(1)
    agent = Agent(SPACES, replace(FAST, hidden=(32,)), 0)
    before = agent.state()
    distance = clone(agent, shown(), 1500, seed=0)
    # The noise on what is seen alone makes 7 (0.02 / 2)^2 = 7e-4.
    assert distance < 0.01
    observation = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 10)).astype(np.float32)
    error = agent.act(observation, explore=False) - 0.5 * observation[:, :7]
    assert np.sqrt((error**2).mean()) < 0.06
    _, log_std = agent.actors["control"](torch.from_numpy(observation))
    assert abs(log_std.exp().mean().item() / SPREAD - 1.0) < 0.2
    for name, network in agent.state()["networks"].items():
        same = all(torch.equal(a, b) for a, b in zip(
            network.values(), before["networks"][name].values(), strict=True))  # fmt: skip
        assert same == (name != "control_actor"), name
