"""`codesign design fit` and `codesign design show`: from a target surface to parameters."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from codesign_design.design_space import DesignSpace
    from codesign_design.finger_pair import TriangleMesh
    from codesign_design.inverse import Fit

UnitOption = Annotated[str, typer.Option(help="Unit of the target's file: mm, m or inch.")]


def fit(
    target: Annotated[Path, typer.Argument(help="Closed surface: STL, OBJ or PLY.")],
    out: Annotated[Path, typer.Option(help="Folder for the results.")],
    handles: Annotated[int, typer.Option(help="Cage handles: 7, 12 or 30.")] = 7,
    base: Annotated[str, typer.Option(help="Base mesh: sphere, torus, box or lip.")] = "sphere",
    unit: UnitOption = "mm",
    centre: Annotated[
        bool, typer.Option(help="Move the target to where the stock finger's pad is.")
    ] = False,
    method: Annotated[
        str, typer.Option(help="icp (closest points) or adam (the paper's).")
    ] = "icp",
    restarts: Annotated[int, typer.Option(help="Starting points.")] = 64,
    seed: Annotated[int, typer.Option(help="Equal seeds give equal fits.")] = 0,
    wall: Annotated[float, typer.Option(help="Thinnest wall to aim at [mm]; 0: any.")] = 0.0,
    closing: Annotated[
        bool, typer.Option(help="Aim at nothing beyond y = 0, where the other finger is.")
    ] = False,
    region: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            help="Box x0 y0 z0 x1 y1 z1 [mm], e.g. around a lip: keep the fit that has it best.",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Find the design parameters whose finger is most like a target surface.

    The target is a left finger in the grasp frame: x sideways, contact side towards -y with its
    foremost point at y = 0, z out of the gripper, 0 at the tool centre point. --centre moves a
    target there that is turned that way but placed elsewhere.

    Writes parameters.json, fit.json, fit.stl and target.stl (millimetres), design.png, curve.png.

    Examples:

    codesign design fit scoop.stl --out runs/scoop --handles 12

    codesign design fit pad.stl --out runs/pad --base box --centre --json
    """
    from codesign_design.design_file import read_surface
    from codesign_design.design_space import design_space
    from codesign_design.inverse import FitOptions
    from codesign_design.inverse import fit as search
    from codesign_design.targets import centred

    with _errors_as_messages("fit"):
        space = design_space(f"{base}-{handles}")
        goal = read_surface(target, unit)
        goal = centred(goal) if centre else goal
        options = FitOptions(
            method=method, restarts=restarts, seed=seed, wall=wall * 1e-3, closing=closing
        )
        box = None if region is None else _corners(region)
        with progress_bar("fitting") as tell:
            result = search(space, goal, options, box, lambda share: tell("fitting", share))
        summary = _write(out, space, goal, result)
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
        return
    typer.echo(
        f"{space.name}: Chamfer {result.chamfer * 1e3:.3f} mm, IoU {result.iou:.3f}, "
        f"{result.seconds:.1f} s; see {out}"
    )


def show(
    design: Annotated[str, typer.Argument(help="A parameter file, or a design space by name.")],
    out: Annotated[Path, typer.Option(help="PNG to write.")] = Path("design.png"),
    target: Annotated[
        Path | None, typer.Option(help="Closed surface to compare with: STL, OBJ or PLY.")
    ] = None,
    unit: UnitOption = "mm",
) -> None:
    """Draw a finger from two sides, its cage and handles, and its distance to a target.

    Examples:

    codesign design show lip-12

    codesign design show runs/scoop/parameters.json --target runs/scoop/target.stl
    """
    import numpy as np

    from codesign_design.design_file import read_parameters, read_surface
    from codesign_design.design_space import design_space, design_space_names
    from codesign_design.pictures import design_picture, save

    with _errors_as_messages("show"):
        if design in design_space_names():
            space = design_space(design)
            parameters = np.zeros(space.parameter_count)
        else:
            space, parameters = read_parameters(Path(design))
        goal = None if target is None else read_surface(target, unit)
        save(design_picture(space, parameters, goal), out)
    typer.echo(out)


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[str, float], None]]:
    """A bar with the time left on standard error; call with a description and the share done."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description:>18}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(description, total=1.0)
        yield lambda what, share: progress.update(task, description=what, completed=share)


@contextmanager
def _errors_as_messages(command: str) -> Iterator[None]:
    """What is wrong with the input goes to standard error, with exit code 2."""
    try:
        yield
    except (ValueError, OSError) as error:
        typer.echo(f"codesign design {command}: {error}", err=True)
        raise typer.Exit(2) from error


def _corners(region: tuple[float, ...]) -> NDArray[np.float64]:
    """The box in metres, (2, 3)."""
    import numpy as np

    corners = np.array(region).reshape(2, 3) * 1e-3
    if not (corners[0] < corners[1]).all():
        raise ValueError(f"region {region} mm: give the lower corner first, x0 y0 z0 x1 y1 z1")
    return corners


def _write(out: Path, space: DesignSpace, goal: TriangleMesh, result: Fit) -> dict:
    """Writes every file of a fit; returns what --json prints."""
    from codesign_design.design_file import write_parameters, write_stl, write_text
    from codesign_design.pictures import curve_picture, design_picture, save

    out.mkdir(parents=True, exist_ok=True)
    summary = {
        "space": space.name,
        "version": space.version,
        "chamfer_mm": result.chamfer * 1e3,
        "iou": result.iou,
        "region_iou": result.region_iou,
        "seconds": result.seconds,
        "parameters": result.parameters.tolist(),
    }
    write_parameters(out / "parameters.json", space, result.parameters)
    write_stl(out / "fit.stl", result.surface)
    write_stl(out / "target.stl", goal)
    curve = {
        "curve_mm": (result.curve * 1e3).tolist(),
        "polished_mm": (result.others * 1e3).tolist(),
    }
    write_text(out / "fit.json", json.dumps({**summary, **curve}, indent=2) + "\n")
    save(design_picture(space, result.parameters, goal), out / "design.png")
    save(curve_picture(result), out / "curve.png")
    return summary
