"""`codesign sim`: check and time the soft-body simulator."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from codesign_sim.validation import Check

app = typer.Typer(help="The soft-body simulator.", no_args_is_help=True)

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")]


@app.command()
def validate(
    case: Annotated[
        list[str] | None, typer.Option("--case", help="Only this case; may be repeated.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the simulator with solutions known from mechanics (about half a minute)."""
    from codesign_sim import validation

    unknown = [name for name in case or [] if name not in validation.CASES]
    if unknown:
        typer.echo(f"No case {unknown[0]!r}; choose from {', '.join(validation.CASES)}.", err=True)
        raise typer.Exit(2)
    checks = _with_progress(case or list(validation.CASES))
    passed = all(check.passed for check in checks)
    if as_json:
        typer.echo(json.dumps({"passed": passed, "cases": [c.as_dict() for c in checks]}, indent=2))
    else:
        _print_checks(checks)
    if not passed:
        raise typer.Exit(1)


@app.command()
def bench(
    as_json: JsonOption = False,
    seconds: Annotated[float, typer.Option(min=0.1, help="Wall time per measurement.")] = 3.0,
) -> None:
    """Measure control steps per second (20 Hz steps with stress, fingers in contact)."""
    from codesign_sim.bench import measure
    from codesign_sim.kernels import LANES

    rates = [measure(tets, count, seconds) for tets in (600, 2400) for count in LANES]
    if as_json:
        typer.echo(json.dumps({"rates": [asdict(rate) for rate in rates]}, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("tetrahedra", "environments", "steps/s", "steps/CPU s", "x real time")
    for rate in rates:
        table.add_row(
            f"{rate.tets:,}",
            str(rate.environments),
            f"{rate.control_steps_per_second:.0f}",
            f"{rate.control_steps_per_cpu_second:.0f}",
            f"{rate.single_core_real_time_factor:.1f}",
        )
    Console().print(table)


@app.command()
def warm_up() -> None:
    """Compile the simulator's kernels for this machine (once, about 10 s)."""
    from codesign_sim import warm_up as compile_all

    compile_all(lambda part, done, parts: typer.echo(f"[{done}/{parts}] {part}", err=True))


def _with_progress(names: list[str]) -> list[Check]:
    """Runs the cases; a bar on standard error shows the time left."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from codesign_sim import validation, warm_up

    checks: list[Check] = []
    columns = (TextColumn("{task.description:>12}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        seconds = [validation.CASES[name][1] for name in names]
        task = progress.add_task("compiling", total=sum(seconds))
        warm_up()
        for name, share in zip(names, seconds, strict=True):
            progress.update(task, description=name)
            checks += next(validation.run([name]))[1]
            progress.advance(task, share)
    return checks


def _print_checks(checks: list[Check]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("case", "expected", "measured", "tolerance", "unit", "verdict")
    for column in table.columns[1:4]:
        column.justify = "right"
    for check in checks:
        verdict = "[green]passed[/]" if check.passed else "[bold red]FAILED[/]"
        table.add_row(
            check.name,
            f"{'>= ' if check.at_least else ''}{check.expected:.5g}",
            f"{check.measured:.5g}",
            f"{check.tolerance:.2g}",
            check.unit,
            verdict,
        )
    console = Console()
    console.print(table)
    failed = sum(not check.passed for check in checks)
    console.print(f"{len(checks) - failed} of {len(checks)} passed")
