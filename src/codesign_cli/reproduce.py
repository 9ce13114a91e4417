"""`codesign reproduce`: the paper's figures, made again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Make the paper's figures again.", no_args_is_help=True)


@app.callback()
def figures() -> None:
    """Make the paper's figures again."""


@app.command()
def figure3(
    out: Annotated[Path, typer.Option(help="Folder for the figure and its numbers.")] = Path(
        "runs/figure3"
    ),
    base: Annotated[
        str, typer.Option(help="Base mesh: sphere (the paper's), box or lip.")
    ] = "sphere",
    restarts: Annotated[int, typer.Option(help="Starting points per fit.")] = 64,
    seed: Annotated[int, typer.Option(help="Equal seeds give equal fits.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Fit quality against the number of cage handles: five targets, 7, 12 and 30 handles.

    Writes figure3.png and figure3.json (about three minutes).

    Example: codesign reproduce figure3 --out runs/figure3 --json
    """
    import torch

    from codesign_cli.fitting import progress_bar
    from codesign_design.design_file import write_text
    from codesign_design.figure3 import HANDLES, draw, fit_all, numbers
    from codesign_design.inverse import FitOptions
    from codesign_design.pictures import save

    torch.set_num_threads(1)
    try:
        with progress_bar("figure 3") as tell:
            fits = fit_all(base, FitOptions(restarts=restarts, seed=seed), tell)
    except ValueError as error:
        typer.echo(f"codesign reproduce figure3: {error}", err=True)
        raise typer.Exit(2) from error
    shown = numbers(base, fits)
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "figure3.json", json.dumps(shown, indent=2) + "\n")
    save(draw(base, fits), out / "figure3.png")
    if as_json:
        typer.echo(json.dumps(shown, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("target", *(f"{h} handles [mm] (IoU)" for h in HANDLES))
    for name in dict.fromkeys(name for name, _ in fits):
        cells = (fits[name, h] for h in HANDLES)
        table.add_row(name, *(f"{c.chamfer * 1e3:.3f} ({c.iou:.2f})" for c in cells))
    table.add_row("mean", *(f"{mean:.3f}" for mean in shown["mean_chamfer_mm"].values()))
    Console().print(table)
