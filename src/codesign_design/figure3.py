"""The paper's Figure 3 again: how fits improve with the number of cage handles."""

from collections.abc import Callable, Mapping

import numpy as np
from matplotlib.figure import Figure

from codesign_design.design_space import design_space
from codesign_design.inverse import Fit, FitOptions, fit
from codesign_design.pictures import FINGER, TARGET, draw_surface
from codesign_design.targets import SCOOP_LIP_REGION, target, target_names

HANDLES = (7, 12, 30)

Fits = Mapping[tuple[str, int], Fit]
"""By target and number of handles."""


def fit_all(
    base: str, options: FitOptions, progress: Callable[[str, float], None]
) -> dict[tuple[str, int], Fit]:
    """Fits every target with every number of handles.

    Args:
        base: base mesh, e.g. "sphere".
        progress: told what is fitted now and the share of everything that is done.
    """
    jobs = [(name, handles) for handles in HANDLES for name in target_names()]
    fits = {}
    for index, (name, handles) in enumerate(jobs):

        def tell(share: float, done: int = index, what: str = f"{base}-{handles} {name}") -> None:
            progress(what, (done + share) / len(jobs))

        region = SCOOP_LIP_REGION if name == "scoop" else None
        fits[name, handles] = fit(
            design_space(f"{base}-{handles}"), target(name), options, region, tell
        )
    return fits


def numbers(base: str, fits: Fits) -> dict:
    """What the figure shows, with means over the targets: Chamfer [mm], IoU, time [s]."""
    rows = [
        {
            "target": name,
            "handles": handles,
            "chamfer_mm": each.chamfer * 1e3,
            "iou": each.iou,
            "lip_iou": each.region_iou,
            "seconds": each.seconds,
            "largest_parameter": float(np.abs(each.parameters).max()),
        }
        for (name, handles), each in fits.items()
    ]
    means = {
        str(handles): float(np.mean([r["chamfer_mm"] for r in rows if r["handles"] == handles]))
        for handles in HANDLES
    }
    return {"base": base, "mean_chamfer_mm": means, "fits": rows}


def draw(base: str, fits: Fits) -> Figure:
    """Targets and their fits as shaded surfaces, and the Chamfer distance over handles."""
    names = target_names()
    figure = Figure(figsize=(12.5, 2.3 * len(names)), layout="constrained")
    grid = figure.add_gridspec(len(names), len(HANDLES) + 2, width_ratios=[1] * 4 + [1.9])
    for row, name in enumerate(names):
        goal = target(name)
        shapes = [goal, *(fits[name, handles].surface for handles in HANDLES)]
        bounds = [shape.vertices for shape in shapes]
        for column, shape in enumerate(shapes):
            axes = figure.add_subplot(grid[row, column], projection="3d")
            draw_surface(axes, shape, FINGER if column else TARGET, bounds)
            if column == 0:
                axes.set_title(f"target: {name}", fontsize=9)
            else:
                each = fits[name, HANDLES[column - 1]]
                title = f"{HANDLES[column - 1]} handles: {each.chamfer * 1e3:.2f} mm"
                axes.set_title(title, fontsize=9)
    chart = figure.add_subplot(grid[:, -1])
    for name in names:
        chart.plot(HANDLES, [fits[name, h].chamfer * 1e3 for h in HANDLES], "o-", label=name)
    means = [numbers(base, fits)["mean_chamfer_mm"][str(h)] for h in HANDLES]
    chart.plot(HANDLES, means, "k--", label="mean")
    chart.set(
        xlabel="cage handles",
        ylabel="mean two-way Chamfer distance [mm]",
        yscale="log",
        xscale="log",
        title=f"base mesh: {base}",
    )
    chart.set_xticks(HANDLES, [str(h) for h in HANDLES])
    chart.minorticks_off()
    ticks = [0.1, 0.2, 0.5, 1.0, 1.5]
    chart.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    chart.grid(which="both", alpha=0.3)
    chart.legend()
    return figure
