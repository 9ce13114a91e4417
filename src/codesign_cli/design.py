"""`codesign design`: finger shapes, from a target or from parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from codesign_cli import fitting, grasping

app = typer.Typer(help="Finger shapes: fit, look at, build, export.", no_args_is_help=True)
app.command()(fitting.fit)
app.command()(fitting.show)
app.command()(grasping.grasp)

JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")]


@app.command()
def spaces(as_json: JsonOption = False) -> None:
    """List the design spaces: base mesh, handles, parameters.

    Example: codesign design spaces --json
    """
    import json

    from codesign_design.design_space import design_space, design_space_names

    rows = [
        {
            "name": space.name,
            "version": space.version,
            "handles": space.handles,
            "parameters": space.parameter_count,
            "parameter_limit": space.parameter_limit,
            "scale_mm": round(1e3 * space.scale, 6),
            "vertices": len(space.weights),
        }
        for space in map(design_space, design_space_names())
    ]
    if as_json:
        typer.echo(json.dumps({"spaces": rows}, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*(key.replace("_", " ") for key in rows[0]))
    for row in rows:
        table.add_row(*(f"{value}" for value in row.values()))
    Console().print(table)


@app.command()
def batch(
    count: Annotated[int, typer.Option(min=1, help="Number of random designs.")] = 100,
    handles: Annotated[int, typer.Option(help="Handles of the cage: 7, 12 or 30.")] = 7,
    base: Annotated[str, typer.Option(help="Base mesh: sphere, torus, box, lip.")] = "sphere",
    sigma: Annotated[
        float, typer.Option(min=0.0, help="Normal displacement of the handles, in sphere radii.")
    ] = 0.6,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    processes: Annotated[int, typer.Option(min=1, help="Processes to share the work.")] = 1,
    as_json: JsonOption = False,
) -> None:
    """Build random designs and count the valid ones; exit code 1 unless all are.

    Valid is watertight, free of self-intersections and in one piece, mount included. Whether such
    a finger can also be printed and used is counted apart. Times are CPU times.

    Example: codesign design batch --count 1000 --handles 30 --sigma 0.6 --processes 2
    """
    from codesign_cli.design_batch import print_batch, run_batch

    try:
        outcome = run_batch(f"{base}-{handles}", count, sigma, seed, processes)
    except ValueError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from error
    print_batch(outcome, as_json)
    if outcome["valid"] < count:
        raise typer.Exit(1)


@app.command()
def build(
    source: Annotated[
        Path, typer.Argument(help="PARAMS.json from `fit`, or an STL, OBJ or PLY surface.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the finger pair's files.")],
    unit: Annotated[str, typer.Option(help="Unit of a surface file: mm, m, inch.")] = "mm",
    name: Annotated[str, typer.Option(help="For people; default: the file's name.")] = "",
    simulators: Annotated[
        bool, typer.Option(help="URDF, MJCF with convex pieces, and distance grids too.")
    ] = True,
    poisson: Annotated[
        bool,
        typer.Option("--poisson", help="Make the body from sampled points, as the paper does."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Make a printable, mounted finger pair; exit code 1 if it cannot be printed or used.

    A surface file holds the left finger in the grasp frame: contact side towards -y, z out of the
    gripper, centre of the stock pad at x = 0, z = -17.5 mm.

    Examples:
      codesign design build params.json --out fingers/fit
      codesign design build my_finger.stl --unit mm --out fingers/mine --json
    """
    from codesign_cli.design_build import build_from_file, print_report, write_page
    from codesign_design.finger_files import save_finger_pair

    try:
        built = build_from_file(source, unit, name or source.stem, poisson)
        save_finger_pair(out, built, simulators=simulators)
        write_page(out, built)
    except (ValueError, OSError) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from error
    print_report(built.report, out, as_json)
    if not built.report.valid:
        raise typer.Exit(1)
