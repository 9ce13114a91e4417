"""`codesign design grasp`: how fingers treat tofu, in the simulator alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from codesign_design.finger_pair import FingerPair

TYPICAL_GRASP = 11.0  # simulated s


def grasp(
    fingers: Annotated[
        list[str] | None,
        typer.Argument(help="Experts' names, STL files (mm) or parameter files; all experts."),
    ] = None,
    grasps: Annotated[int, typer.Option(min=1, max=64, help="Per pair of fingers.")] = 16,
    tetrahedra: Annotated[int, typer.Option(help="Resolution: 600, 2400 or 8100.")] = 2400,
    tighter: Annotated[
        float, typer.Option(min=-2.0, max=2.0, help="Close further than planned [mm].")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the first block.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Let fingers pick tofu up, with the scripted grasp that suits their shape.

    Blocks differ in stiffness and place as in every trial; the first half of them has a friction
    of 0.4, the other one of 0.5. Stresses are means over the grasps that succeeded.

    Exit codes: 0 every grasp succeeded, 1 one did not, 2 unusable fingers.

    Examples:

    codesign design grasp

    codesign design grasp stock my_finger.stl --grasps 8 --tighter 0.2 --json
    """
    from rich.console import Console
    from rich.progress import Progress

    rows = []
    try:
        pairs = [_pair(name) for name in fingers or _experts()]
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("grasping", total=len(pairs) * TYPICAL_GRASP)
            for k, pair in enumerate(pairs):

                def show(time: float, before: float = k * TYPICAL_GRASP) -> None:
                    progress.update(task, completed=before + min(time, TYPICAL_GRASP))

                rows.append(_judge(pair, grasps, tetrahedra, tighter * 1e-3, seed, show))
    except (ValueError, OSError) as error:
        typer.echo(f"grasp: {error}", err=True)
        raise typer.Exit(2) from None
    if as_json:
        typer.echo(json.dumps({"fingers": rows}, indent=2))
    else:
        _print(rows)
    if any(row["succeeded"] < row["grasps"] for row in rows):
        raise typer.Exit(1)


def _experts() -> list[str]:
    from codesign_design.experts import expert_names

    return expert_names()


def _pair(name: str) -> FingerPair:
    """An expert's fingers, or those of a file, which must be usable."""
    from codesign_design.build import build_finger
    from codesign_design.design_file import read_parameters, read_surface
    from codesign_design.experts import expert

    if name in _experts():
        return expert(name)
    path = Path(name)
    if path.suffix == ".json":
        space, parameters = read_parameters(path)
        built = build_finger(space.surface(parameters), path.stem, space.name, parameters)
    else:
        built = build_finger(read_surface(path), path.stem)
    if not built.report.valid:
        raise ValueError(f"{name} cannot be used: {'; '.join(built.report.problems)}")
    return built.pair


def _judge(
    fingers: FingerPair,
    grasps: int,
    tetrahedra: int,
    tighter: float,
    seed: int,
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    from dataclasses import replace

    from codesign_policy.domain import TrialDomain, draw_domain
    from codesign_policy.finger_plan import plan_for
    from codesign_policy.grasp_trials import run_grasps, summary

    plan = plan_for(fingers)
    plan = replace(plan, width=plan.width - tighter)
    domains = [
        draw_domain(seed + k, TrialDomain(friction=0.4 if 2 * k < grasps else 0.5))
        for k in range(grasps)
    ]
    trials = run_grasps(fingers, [plan] * grasps, domains, tetrahedra, on_progress)
    return {"name": fingers.name, "width_mm": round(plan.width * 1e3, 3)} | summary(trials)


def _print(rows: list[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("fingers", "gap [mm]", "succeeded", title="Stress, top-10 % / median [Pa]")
    for column in ("held", "mean over contact", "highest top-10 %"):
        table.add_column(column, justify="right")
    for row in rows:
        table.add_row(
            row["name"],
            f"{row['width_mm']:.2f}",
            f"{row['succeeded']} of {row['grasps']}",
            f"{row['held_top10_pa']:.0f} / {row['held_median_pa']:.0f}",
            f"{row['contact_top10_pa']:.0f} / {row['contact_median_pa']:.0f}",
            f"{row['peak_top10_pa']:.0f}",
        )
    Console().print(table)
