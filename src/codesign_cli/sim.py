"""`codesign sim`: check and time the soft-body simulator."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from codesign_sim.validation import Check

app = typer.Typer(help="The soft-body simulator.", no_args_is_help=True)


class Peer(StrEnum):
    """Simulators to compare with."""

    MUJOCO = "mujoco"


JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")]


@app.command()
def validate(
    case: Annotated[
        list[str] | None, typer.Option("--case", help="Only this case; may be repeated.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compare the simulator with solutions known from mechanics (about half a minute)."""
    from codesign_cli.sim_tables import print_checks
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
        print_checks(checks)
    if not passed:
        raise typer.Exit(1)


@app.command()
def bench(
    peer: Annotated[
        Peer | None, typer.Option(help="Time this simulator's soft body, too, in the same run.")
    ] = None,
    device: Annotated[str, typer.Option(help="cpu, or cuda for the GPU beside it.")] = "cpu",
    seconds: Annotated[float, typer.Option(min=0.1, help="Wall time per row, at least.")] = 3.0,
    as_json: JsonOption = False,
) -> None:
    """Measure control steps per second: 20 Hz steps of closing, lifting and holding, with stress.

    One environment and a full vector of them, in one and two processes. Figures per CPU second
    are those to compare on a busy machine.

    Examples: codesign sim bench --peer mujoco; codesign sim bench --json --seconds 10
    """
    from codesign_cli.sim_tables import print_rates
    from codesign_design.stock import stock_fingers
    from codesign_sim import SurfaceMesh, bench, warm_up

    pair = stock_fingers()
    left, right = (SurfaceMesh(m.vertices, m.faces) for m in (pair.left, pair.right))
    warm_up()
    cases = bench.cases(device, peer and peer.value)
    try:
        with _bar() as step:
            results = bench.run(cases, (left, right), seconds, progress=step)
    except ValueError as error:  # no such device
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from None
    machine, ratios = bench.describe_machine(), bench.ratios(results)
    if not as_json:
        print_rates(results, machine, ratios)
        return
    report: dict[str, object] = {
        "machine": machine,
        "results": [result.as_dict() for result in results],
    }
    if ratios:
        report["ratio_vs_mujoco_flex"] = ratios[600]
        report["ratio_vs_mujoco_flex_by_tets"] = ratios
    typer.echo(json.dumps(report, indent=2))


@app.command()
def sensitivity(
    width: Annotated[float, typer.Option(help="Gap the fingers close to [m].")] = 0.026,
    friction: Annotated[float, typer.Option(help="Coulomb coefficient.")] = 0.5,
    tets: Annotated[int, typer.Option(help="Tetrahedra: 600, 2400 or 8100.")] = 2400,
    as_json: JsonOption = False,
) -> None:
    """Show how the held block's stress depends on a flat pad's dimensions.

    Central finite differences around a pad of the stock finger's size; every perturbed pair is one
    environment of a single simulation.

    Examples: codesign sim sensitivity; codesign sim sensitivity --width 0.0265 --json
    """
    from codesign_cli.sim_tables import print_gradient
    from codesign_sim import Block, Material
    from codesign_sim.pads import PARAMETERS, flat_pads
    from codesign_sim.sensitivity import Grasp, stress_gradient

    try:
        grasp = Grasp(width, material=Material(friction=friction), block=Block.tofu(tets))
        with _bar() as step:
            gradient = stress_gradient(
                lambda p: flat_pads(*p),
                [parameter.value for parameter in PARAMETERS],
                [parameter.step for parameter in PARAMETERS],
                grasp,
                progress=lambda done, total: step("grasp", done, total),
            )
    except ValueError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from None
    if as_json:
        names = [parameter.name for parameter in PARAMETERS]
        typer.echo(json.dumps({"names": names, **gradient.as_dict()}, indent=2))
    else:
        print_gradient(PARAMETERS, gradient)


@app.command("object")
def check_object(
    file: Annotated[
        Path,
        typer.Argument(exists=True, dir_okay=False, help="Tetrahedral mesh, any meshio format."),
    ],
    scale: Annotated[
        float, typer.Option(help="Metres per unit of the file; 0.001 for millimetres.")
    ] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """Check a tetrahedral mesh of your own and say what simulating it means.

    Mass and time step are those of the paper's tofu. Exit code 1: the mesh cannot be simulated.

    Examples: codesign sim object tofu.msh; codesign sim object tofu_mm.vtu --scale 0.001 --json
    """
    import warnings

    from codesign_cli.sim_tables import print_object
    from codesign_sim import Material, TetrahedralMesh
    from codesign_sim.object_report import report_on

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            mesh = TetrahedralMesh.from_file(file, scale)
        except ValueError as error:
            if as_json:
                typer.echo(json.dumps({"sound": False, "error": str(error)}, indent=2))
            typer.echo(str(error), err=True)
            raise typer.Exit(1) from None
    report, notes = report_on(mesh, Material()), [str(w.message) for w in caught]
    if as_json:
        typer.echo(json.dumps({"sound": True, **report.as_dict(), "notes": notes}, indent=2))
    else:
        print_object(report, notes)


@app.command()
def warm_up() -> None:
    """Compile the simulator's kernels for this machine (once, about 10 s)."""
    from codesign_sim import warm_up as compile_all

    compile_all(lambda part, done, parts: typer.echo(f"[{done}/{parts}] {part}", err=True))


def _with_progress(names: list[str]) -> list[Check]:
    """Runs the cases; a bar on standard error shows the time left."""
    from codesign_sim import validation, warm_up

    checks: list[Check] = []
    seconds = [validation.CASES[name][1] for name in names]
    with _bar() as step:
        step("compiling", 0, sum(seconds))
        warm_up()
        for k, name in enumerate(names):
            step(name, sum(seconds[:k]), sum(seconds))
            checks += next(validation.run([name]))[1]
    return checks


@contextmanager
def _bar() -> Iterator[Callable[[str, float, float], None]]:
    """A bar on standard error; call what it yields with (what, steps done, steps in all)."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:>16}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("starting", total=None)
        yield lambda what, done, total: progress.update(
            task, description=what, completed=done, total=total
        )
