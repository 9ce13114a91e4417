"""How fast the learner is: updates of the critics per second of CPU time."""

import time
from dataclasses import dataclass

import numpy as np
import torch

from codesign_policy.presets import Preset
from codesign_policy.replay import ReplayBuffer, Spaces, Transitions, sample_batch
from codesign_policy.rlpd import Agent

SPACES = Spaces(observation=29, design=21, control=7)  # a cage of 7 handles
ROWS = 5000
EPISODE = 200  # rows of control per row of design


@dataclass(frozen=True)
class UpdateRate:
    """Measured rate; drawing the batch, target and actor updates are included.

    Attributes:
        preset: its name.
        updates: how many were timed.
        updates_per_cpu_second: of the critics, on one thread.
        cpu_ms_per_update: its inverse [ms].
        transitions_per_cpu_second: that the learner keeps up with, at the preset's ratio.
    """

    preset: str
    updates: int
    updates_per_cpu_second: float
    cpu_ms_per_update: float
    transitions_per_cpu_second: float


def measure(preset: Preset, seconds: float = 5.0) -> UpdateRate:
    """Updates an agent from made-up rows for about `seconds` of CPU time, on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        agent, buffer = Agent(SPACES, preset, seed=0), _rows()
        random = np.random.default_rng(0)

        def update() -> None:
            agent.update(
                sample_batch(
                    [buffer, buffer], preset.batch_size, preset.design_rows, {"r": 1.0}, random
                )
            )

        for _ in range(2 * preset.actor_period):  # first calls allocate
            update()
        updates, start = 0, time.process_time()
        while (spent := time.process_time() - start) < seconds:
            for _ in range(preset.actor_period):
                update()
            updates += preset.actor_period
    finally:
        torch.set_num_threads(threads)
    rate = updates / spent
    return UpdateRate(
        preset=preset.name,
        updates=updates,
        updates_per_cpu_second=rate,
        cpu_ms_per_update=1e3 / rate,
        transitions_per_cpu_second=rate / preset.updates_per_transition,
    )


def _rows() -> ReplayBuffer:
    random = np.random.default_rng(0)
    buffer = ReplayBuffer(SPACES, ("r",), ROWS)
    no = np.zeros(ROWS, dtype=bool)
    buffer.insert(
        Transitions(
            observation=random.normal(size=(ROWS, SPACES.observation)).astype(np.float32),
            action=random.uniform(-1.0, 1.0, (ROWS, SPACES.action)).astype(np.float32),
            in_control=np.arange(ROWS) % (EPISODE + 1) != 0,
            components=random.normal(size=(ROWS, 1)).astype(np.float32),
            next_observation=random.normal(size=(ROWS, SPACES.observation)).astype(np.float32),
            terminated=no,
            truncated=no,
        )
    )
    return buffer
