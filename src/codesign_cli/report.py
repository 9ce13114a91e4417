"""`codesign bag ...` and `codesign report`: metrics, videos and pages of recorded trials."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

bag_app = typer.Typer(help="Recorded trials (rosbag2, MCAP).", no_args_is_help=True)

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


@bag_app.callback()
def _bag() -> None:
    """Keeps `metrics` a subcommand while it is the only one."""


@bag_app.command("metrics")
def bag_metrics(
    bag: Annotated[Path, typer.Argument(help="rosbag2 folder or .mcap file of one trial.")],
    as_json: AsJson = False,
) -> None:
    """Print the grasp metrics of a recorded trial."""
    from codesign_report import read_trial, trial_metrics

    try:
        trial = read_trial(bag)
        metrics = trial_metrics(trial)
    except ValueError as error:
        _fail(error)
    if as_json:
        values = {"gripper": trial.gripper, "seed": trial.seed, **asdict(metrics)}
        print(json.dumps({key: _or_null(value) for key, value in values.items()}))
        return
    _print_rows(
        f"{trial.gripper}, seed {trial.seed}",
        [
            ("picked up", "yes" if metrics.success else "no"),
            ("top-10 % stress", _quantity(metrics.top10_stress, 0, "Pa")),
            ("median stress", _quantity(metrics.median_stress, 0, "Pa")),
            ("peak lift", _quantity(1e3 * metrics.peak_lift, 1, "mm")),
            ("held force", _quantity(metrics.held_force, 3, "N")),
            ("weight", _quantity(trial.weight, 3, "N")),
            ("interaction", _quantity(metrics.interaction_time, 2, "s")),
            ("score", _quantity(metrics.score, 1, "")),
        ],
    )


def report(
    run_dir: Annotated[Path, typer.Argument(help="Folder that holds the trials' bags.")],
    as_json: AsJson = False,
) -> None:
    """Render a video per trial and write summary.json and report.html into the folder."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from codesign_report import build

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} pictures"),
        TimeRemainingColumn(),
    )
    try:
        quiet = not console.is_terminal
        with Progress(*columns, console=console, transient=True, disable=quiet) as bar:
            task = bar.add_task("reading", total=None)
            result = build(
                run_dir,
                progress=lambda done, total, name: bar.update(
                    task, completed=done, total=total, description=name
                ),
            )
    except ValueError as error:
        _fail(error)
    except (RuntimeError, OSError) as error:
        _fail(error, code=1)
    if as_json:
        print(result.summary.read_text(encoding="utf-8"), end="")
        return
    for skipped in result.skipped:
        typer.echo(f"left out: {skipped.reason}", err=True)
    print(result.page)


def _fail(error: Exception, code: int = 2) -> NoReturn:
    """One line, no traceback."""
    typer.echo(f"error: {' '.join(str(error).split())}", err=True)
    raise typer.Exit(code)


def _or_null(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _quantity(value: float, decimals: int, unit: str) -> str:
    return f"{value:.{decimals}f} {unit}".strip() if math.isfinite(value) else "not defined"


def _print_rows(title: str, rows: list[tuple[str, str]]) -> None:
    print(title)
    for label, value in rows:
        print(f"  {label:<16} {value}")
