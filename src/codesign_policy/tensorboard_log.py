"""A run's curves for TensorBoard: `tensorboard --logdir <folder>`."""

from pathlib import Path
from types import TracebackType

import numpy as np

from codesign_policy.training import Progress


class TensorBoardLog:
    """Writes each round's numbers; to be called as `Training.run(on_round=...)`.

    The horizontal axis is transitions of the control stage.
    """

    def __init__(self, folder: Path, transitions: int = 0) -> None:
        """Args: where; how far the run is that goes on: what was written beyond is dropped."""
        from torch.utils.tensorboard import SummaryWriter  # takes a second or more

        self._writer = SummaryWriter(str(folder), purge_step=transitions + 1)

    def __call__(self, progress: Progress) -> None:
        """Writes one round."""
        groups = {
            "round": {"return": progress.episode_return},
            "metrics": progress.metrics,
            "losses": progress.losses,
            "seconds": progress.seconds,
        }
        for group, values in groups.items():
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", value, progress.transitions)
        if progress.designs is not None:
            spread = float(np.std(progress.designs, axis=0).mean())
            self._writer.add_scalar("round/design_spread", spread, progress.transitions)

    def __enter__(self) -> "TensorBoardLog":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()
