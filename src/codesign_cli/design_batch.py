"""Runs `codesign design batch`: random designs in one or more processes, and their summary."""

from __future__ import annotations

import json
import multiprocessing
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from statistics import median
from typing import Any

import typer

from codesign_design.batch import Outcome, RandomDesign, build_random
from codesign_design.design_space import design_space


def run_batch(space: str, count: int, sigma: float, seed: int, processes: int) -> dict[str, Any]:
    """Builds the designs and returns the summary.

    Raises:
        ValueError: no such design space.
    """
    design_space(space)
    designs = [RandomDesign(space, sigma, seed, index) for index in range(count)]
    with _workers(processes, designs) as outcomes:
        return summarise(space, sigma, seed, list(_with_progress(outcomes, count)))


def summarise(space: str, sigma: float, seed: int, outcomes: list[Outcome]) -> dict[str, Any]:
    """Counts, times, and the reasons of whatever failed."""
    invalid = [o for o in outcomes if o.problems]
    reasons = Counter(_kind(p) for o in outcomes for p in o.print_problems)
    return {
        "space": space,
        "sigma": sigma,
        "seed": seed,
        "count": len(outcomes),
        "valid": len(outcomes) - len(invalid),
        "median_ms": round(median(o.seconds for o in outcomes) * 1e3, 1),
        "report_median_ms": round(median(o.report_seconds for o in outcomes) * 1e3, 1),
        "remeshed": sum(o.remeshed for o in outcomes),
        "printable": sum(not o.problems and not o.print_problems for o in outcomes),
        "not_printable": dict(reasons.most_common()),
        "invalid": [{"index": o.design.index, "problems": list(o.problems)} for o in invalid],
    }


def print_batch(outcome: dict[str, Any], as_json: bool) -> None:
    """The summary as JSON or as a table."""
    if as_json:
        typer.echo(json.dumps(outcome, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("", outcome["space"], show_header=True)
    for key in ("count", "valid", "remeshed", "printable", "median_ms", "report_median_ms"):
        table.add_row(key.replace("_", " "), str(outcome[key]))
    for reason, number in outcome["not_printable"].items():
        table.add_row(f"  {reason}", str(number))
    console = Console()
    console.print(table)
    for failure in outcome["invalid"]:
        console.print(f"[red]design {failure['index']}[/]: {'; '.join(failure['problems'])}")


def _kind(problem: str) -> str:
    """A problem without its numbers, so that equal ones can be counted."""
    words = problem.split(",")[0].split()
    return " ".join(word for word in words if not word[0].isdigit()).removesuffix(" mm")


@contextmanager
def _workers(processes: int, designs: list[RandomDesign]) -> Iterator[Iterable[Outcome]]:
    if processes == 1:
        yield map(build_random, designs)
        return
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        yield pool.imap(build_random, designs, chunksize=4)


def _with_progress(outcomes: Iterable[Outcome], count: int) -> Iterator[Outcome]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("building"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=count)
        for outcome in outcomes:
            yield outcome
            progress.advance(task)
