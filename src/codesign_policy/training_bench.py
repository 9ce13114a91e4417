"""How fast a run goes in all, and where its time goes."""

from dataclasses import dataclass

import torch

from codesign_policy.run import RunConfig, make_training, shown_rows
from codesign_policy.training import Progress


@dataclass(frozen=True)
class TrainingRate:
    """Measured over whole rounds, on one thread, after a first round.

    Attributes:
        preset: of the learner.
        space: design space; the designs are changed as in a run.
        lanes, rounds: how many.
        environment_steps_per_second: control steps of all lanes over wall time.
        simulation, updates, rest: shares of the wall time; building fingers is simulation.
    """

    preset: str
    space: str
    lanes: int
    rounds: int
    environment_steps_per_second: float
    simulation: float
    updates: float
    rest: float


def measure_training(preset: str = "fast", rounds: int = 2, lanes: int = 16) -> TrainingRate:
    """Trains for `rounds` rounds and one before them, of a co-design run from its start."""
    shown = shown_rows(RunConfig().space)
    config = RunConfig(preset=preset, lanes=lanes, start=shown.gentlest.parameters)
    seen: list[Progress] = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        training = make_training(config, shown.rows)
        training.run(None, seen.append, lambda: len(seen) > rounds)
    finally:
        torch.set_num_threads(threads)
    measured = seen[1:]
    spent = {
        name: sum(progress.seconds[name] for progress in measured)
        for name in ("simulation", "updates", "rest")
    }
    total = sum(spent.values())
    steps = measured[-1].transitions - seen[0].transitions
    return TrainingRate(
        preset=preset,
        space=config.space,
        lanes=lanes,
        rounds=rounds,
        environment_steps_per_second=steps / total,
        **{name: value / total for name, value in spent.items()},
    )
