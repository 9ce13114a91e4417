"""Behaviour cloning: a controller that starts near what was demonstrated.

One demonstration shows one way through the observations; noise on them teaches the controller to
come back to it.
"""

import numpy as np
import torch

from codesign_policy.replay import ReplayBuffer
from codesign_policy.rlpd import Agent

OBSERVED_NOISE = 0.02  # of normalised observations: 2 mm, 0.6 mm of the gap
DESIGN_NOISE = 0.02  # of design parameters: the spread of designs that are tried
SPREAD = 0.14  # of actions: the entropy of seven such numbers is about -4 nats
LEARNING_RATE = 1e-3
STATED = 7  # numbers of the observation that vary in an episode


def clone(agent: Agent, demonstrations: ReplayBuffer, updates: int, seed: int) -> float:
    """Fits the control actor to demonstrated actions, and its spread to `SPREAD`.

    Args:
        agent: its control actor is changed, nothing else.
        demonstrations: rows of both stages.
        updates: steps of Adam, over all rows each.
        seed: of the noise.

    Returns:
        Mean squared distance to the demonstrated actions at the last step.
    """
    rows = demonstrations.rows
    control = rows.in_control
    seen = torch.from_numpy(rows.observation[control])
    shown = torch.from_numpy(rows.action[control][:, agent.spaces.design :])
    scale = torch.zeros(agent.spaces.observation)
    scale[:STATED], scale[8:] = OBSERVED_NOISE, DESIGN_NOISE
    actor = agent.actors["control"]
    optimizer = torch.optim.Adam(actor.parameters(), lr=LEARNING_RATE)
    random = torch.Generator().manual_seed(seed)
    distance = torch.zeros(())
    for _ in range(updates):
        mean, log_std = actor(seen + scale * torch.randn(seen.shape, generator=random))
        distance = (torch.tanh(mean) - shown).square().sum(-1).mean()
        spread = (log_std - np.log(SPREAD)).square().mean()
        optimizer.zero_grad()
        (distance + 0.1 * spread).backward()
        optimizer.step()
    return distance.item()
