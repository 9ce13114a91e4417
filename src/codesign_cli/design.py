"""`codesign design`: finger shapes, from a target or from parameters."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(help="Finger shapes: fit, look at, build, export.", no_args_is_help=True)

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
