"""`codesign policy demonstrate`, `import-demonstrations`, `export-demonstrations`."""

from __future__ import annotations

import json
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from codesign_policy.demonstrations import Demonstrations


class Format(StrEnum):
    """Formats of others."""

    lerobot = "lerobot"
    minari = "minari"


def demonstrate(
    out: Annotated[Path, typer.Option(help="Folder to write: a Minari dataset.")],
    space: Annotated[str, typer.Option(help="Design space: base mesh and handles.")] = "wide-12",
    expert: Annotated[
        list[str] | None,
        typer.Option(help="Whose fingers; may be repeated. Default: flat_pad, cupped_pad, scoop."),
    ] = None,
    tets: Annotated[int, typer.Option(help="Resolution of the block: 600 or 2400.")] = 2400,
    seed: Annotated[int, typer.Option(min=0, help="Of fits and block.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Demonstrate: fit each expert's finger in a design space, and pick tofu up with it.

    Writes a transition of the design stage and 200 of the control stage for each, for RLPD.
    Nothing is written unless every grasp succeeds.

    Exit codes: 0 done, 1 a grasp failed or a fitted finger is unusable, 2 bad input, 3 the
    simulation failed.

    Example: codesign policy demonstrate --space box-12 --out runs/box-12 --json
    """
    from rich.console import Console
    from rich.progress import Progress

    from codesign_policy.demonstrations import METADATA
    from codesign_policy.expert_demonstrations import EXPERTS
    from codesign_policy.expert_demonstrations import demonstrate as make
    from codesign_policy.expert_plan import DemonstrationError
    from codesign_policy.files import require_replaceable
    from codesign_sim import SimulationError

    try:
        require_replaceable(out, METADATA)  # before half a minute is spent
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("", total=1.0)

            def show(what: str, share: float) -> None:
                progress.update(task, description=what, completed=share)

            made = make(space, expert or EXPERTS, tetrahedra=tets, seed=seed, progress=show)
        command = f"codesign policy demonstrate --space {space} --tets {tets} --seed {seed}"
        command += "".join(f" --expert {name}" for name in expert or [])
        replace(made, made_by=command).save(out)
    except DemonstrationError as error:
        typer.echo(f"demonstrate: {error}", err=True)
        raise typer.Exit(1) from None
    except SimulationError as error:
        typer.echo(f"demonstrate: {error}", err=True)
        raise typer.Exit(3) from None
    except (ValueError, OSError) as error:
        typer.echo(f"demonstrate: {error}", err=True)
        raise typer.Exit(2) from None
    _print(made, out, as_json)


def import_demonstrations(
    bags: Annotated[list[Path], typer.Argument(help="Recorded trials: rosbag2 folders.")],
    out: Annotated[Path, typer.Option(help="Folder to write: a Minari dataset.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Import demonstrations from recorded trials, of a person at the controls or of a policy.

    All bags must be trials that succeeded in the simulator, with fingers of one design space.

    Exit codes: 0 done, 2 a bag that cannot be used: nothing is written.

    Example: codesign policy import-demonstrations runs/shown/mine-seed* --out runs/mine
    """
    from rich.console import Console
    from rich.progress import Progress

    from codesign_report.bag_demonstrations import import_demonstrations as read

    try:
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("reading bags", total=1.0)
            made = read(bags, lambda share: progress.update(task, completed=share))
        command = f"codesign policy import-demonstrations {' '.join(bag.name for bag in bags)}"
        replace(made, made_by=command).save(out, "recorded-v0")
    except (ValueError, OSError) as error:
        typer.echo(f"import-demonstrations: {error}", err=True)
        raise typer.Exit(2) from None
    _print(made, out, as_json)


def export_demonstrations(
    source: Annotated[
        str, typer.Argument(help="A design space whose demonstrations are shipped, or a folder.")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    form: Annotated[Format, typer.Option("--format", help="What to write.")] = Format.lerobot,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Export demonstrations: as a LeRobot dataset (format v3.0), or copied as the Minari dataset.

    Exit codes: 0 done, 2 bad input: nothing is written.

    Example: codesign policy export-demonstrations wide-12 --format lerobot --out runs/lerobot
    """
    from codesign_policy.demonstrations import demonstrations_path, load_demonstrations
    from codesign_policy.lerobot_export import export_lerobot

    try:
        made = load_demonstrations(demonstrations_path(source))
        if form is Format.lerobot:
            export_lerobot(made, out)
        else:
            made.save(out)
    except (ValueError, OSError) as error:
        typer.echo(f"export-demonstrations: {error}", err=True)
        raise typer.Exit(2) from None
    _print(made, out, as_json)


def _print(made: Demonstrations, out: Path, as_json: bool) -> None:
    rows: list[dict[str, Any]] = [
        {
            "expert": episode.expert,
            "top10_stress_pa": episode.top10_stress,
            "median_stress_pa": episode.median_stress,
            "gap_mm": 1e3 * episode.width,
            "gaps_that_hold": episode.gaps_that_hold,
            "chamfer_mm": None if episode.chamfer is None else 1e3 * episode.chamfer,
        }
        for episode in made.episodes
    ]
    if as_json:
        summary = {"space": made.space, "folder": str(out), "transitions": len(made.rows)}
        typer.echo(json.dumps({**summary, "demonstrations": rows}, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*(name.replace("_", " ") for name in rows[0]), title=f"{made.space}: {out}")
    for row in rows:
        table.add_row(*(_shown(value) for value in row.values()))
    Console().print(table)


def _shown(value: float | str | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
