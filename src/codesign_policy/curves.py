"""Pictures of a training run: its curves, and the finger that it ended with."""

import csv
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codesign_policy.files import replacing

SMOOTHED = 5  # rounds in the moving mean
PANELS = (
    ("success", "success rate"),
    ("top10_stress", "top-10 % stress [Pa]"),
    ("median_stress", "median stress [Pa]"),
    ("episode_return", "return"),
)


def read_history(folder: Path) -> dict[str, NDArray[np.float64]]:
    """Columns of a run's history.csv; NaN where a round did not know a number.

    Raises:
        ValueError: no history there.
    """
    try:
        with (folder / "history.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise ValueError(f"{folder}: no history.csv: name the folder of a run") from error
    if not rows:
        raise ValueError(f"{folder}: its history is empty: let it train for a round")
    return {name: np.array([float(row[name] or "nan") for row in rows]) for row in rows[:1]
            for name in row}  # fmt: skip


def draw_curves(histories: dict[str, dict[str, NDArray[np.float64]]], path: Path) -> None:
    """Draws success, stresses and return over transitions, every run in its colour (PNG).

    Args:
        histories: columns by name of the run.
        path: of the picture, replaced.
    """
    figure = Figure(figsize=(11.0, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (column, label) in zip(figure.subplots(2, 2).flat, PANELS, strict=True):
        for number, (name, history) in enumerate(histories.items()):
            x = history["transitions"] / 1e3
            y = history.get(column, np.full(len(x), np.nan))
            colour = f"C{number}"
            axes.plot(x, y, color=colour, alpha=0.25, linewidth=0.8)
            axes.plot(x, moving_mean(y), color=colour, linewidth=1.8, label=name)
        axes.set_xlabel("transitions [thousand]")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
        if column != "episode_return":
            axes.set_ylim(bottom=0.0)
    figure.axes[0].legend(loc="lower right", frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def moving_mean(values: NDArray[np.float64], width: int = SMOOTHED) -> NDArray[np.float64]:
    """Mean of the last `width` values that are known, at every place; NaN where there is none."""
    known = np.isfinite(values)
    kernel = np.ones(width)
    total = np.convolve(np.where(known, values, 0.0), kernel)[: len(values)]
    count = np.convolve(known, kernel)[: len(values)]
    return np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)
