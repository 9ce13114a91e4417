"""`codesign report`: videos and pages of recorded trials."""

import os
from pathlib import Path
from typing import Annotated

import typer

from codesign_cli.bag import fail

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


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
                processes=len(os.sched_getaffinity(0)),
            )
    except ValueError as error:
        fail(error)
    except (RuntimeError, OSError) as error:
        fail(error, code=1)
    if as_json:
        print(result.summary.read_text(encoding="utf-8"), end="")
        return
    for skipped in result.skipped:
        typer.echo(f"left out: {skipped.reason}", err=True)
    print(result.page)
