"""`codesign control`: checks and timings of the arm's kinematics and servo."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import numpy as np

    from codesign_control.limit_check import LimitReport

app = typer.Typer(help="xArm7 kinematics and Cartesian servo.", no_args_is_help=True)

Json = Annotated[bool, typer.Option("--json", help="One JSON object instead of a table.")]


@app.command()
def fk(
    poses: Annotated[
        Path,
        typer.Option(help='JSON: {"poses": [{"q_rad", "flange_position_m", "flange_rotation"}]}.'),
    ],
    as_json: Json = False,
) -> None:
    """Compare the forward kinematics of the flange with given poses.

    Exit code 0: compared. 2: the file is missing or malformed; the message names the entry.
    """
    import numpy as np

    from codesign_control import Xarm7

    try:
        expected = _read_poses(poses)
    except (OSError, ValueError) as error:
        typer.echo(f"{poses}: {error}", err=True)
        raise typer.Exit(2) from error
    arm = Xarm7()
    position_errors, rotation_errors = [], []
    for q, position, rotation in expected:
        flange = arm.fk_flange(q)
        position_errors.append(float(np.linalg.norm(flange.position - position)))
        rotation_errors.append(_angle_between(flange.rotation, rotation))
    _print(
        {
            "poses": len(expected),
            "max_position_error_m": max(position_errors),
            "max_rotation_error_rad": max(rotation_errors),
        },
        as_json,
    )


@app.command()
def bench(
    steps: Annotated[int, typer.Option(min=100, help="Control steps to time.")] = 2000,
    as_json: Json = False,
) -> None:
    """Time the servo's control step while it follows a stream of actions around a circle."""
    import math
    from time import perf_counter

    import numpy as np

    from codesign_control import CartesianServo, Xarm7

    arm = Xarm7()
    servo = CartesianServo(arm)
    servo.enable(arm.home, 0.0)
    ticks = round(servo.config.action_period / servo.config.period)
    position, durations = arm.home, []
    for i in range(steps):
        now = i * servo.config.period
        if i % ticks == 0:
            step = 0.005 * np.array([math.cos(2 * now), math.sin(2 * now), 0.0])
            servo.submit(step, np.zeros(3), now)
        start = perf_counter()
        position = servo.step(position, now).position
        durations.append(perf_counter() - start)
    p50, p99, worst = (float(us) for us in np.percentile(durations, [50, 99, 100]) * 1e6)
    _print({"steps": steps, "p50_us": p50, "p99_us": p99, "max_us": worst}, as_json)


class Through(StrEnum):
    """How far hostile actions are followed."""

    servo = "servo"
    driver = "driver"


@app.command()
def adversarial(
    actions: Annotated[int, typer.Option(min=1, help="Hostile actions to send.")] = 1_000_000,
    seed: Annotated[int, typer.Option(min=0, help="Equal seeds give equal results.")] = 0,
    through: Annotated[
        Through,
        typer.Option(help="driver: on through the arm's driver, to what would be on the wire."),
    ] = Through.servo,
    box_log: Annotated[
        Path | None,
        typer.Option(help="File for that, as a control box logs it: JSON lines, 0.3 kB a point."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Send a servo the worst actions there are and check every set-point that comes out.

    NaN, infinite and huge ones, floods, sawteeth, pushes towards singularities, joint limits, the
    arm itself, the table and the corners of the workspace box. Through the driver, that gets
    hostile set-points as well. Exit code 1: a limit was violated; 2: --box-log without a driver.
    """
    from rich.console import Console
    from rich.progress import Progress

    from codesign_control import adversary

    if box_log and through is not Through.driver:
        typer.echo("--box-log: only with --through driver, else there is no wire", err=True)
        raise typer.Exit(2)
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("actions", total=actions)

        def show(done: int, _: adversary.Outcome) -> None:
            progress.update(task, completed=done)

        outcome = adversary.run(
            actions,
            seed,
            progress=show,
            through_driver=through is Through.driver,
            box_log_file=box_log,
        )
    assert outcome.limits is not None
    if as_json:
        typer.echo(json.dumps(outcome.to_dict()))
    else:
        _print_limits(outcome.limits)
        for found in outcome.wire[:5]:
            typer.echo(f"on the wire: {found}")
        _print({**outcome.counts, "wire_violations": len(outcome.wire)}, as_json=False)
    raise typer.Exit(1 if outcome.violations else 0)


def _print_limits(report: LimitReport) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("limit", "must be", "worst", "unit", "violations")
    for found in report.findings.values():
        bound = f"{'>=' if found.at_least else '<='} {found.limit:g}"
        table.add_row(found.name, bound, f"{found.worst:.6g}", found.unit, str(found.violations))
    Console().print(f"{report.set_points} set-points, {report.violations} violations")
    Console().print(table)


def _read_poses(path: Path) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(7,) joints, (3,) position, (3, 3) rotation of every entry; ValueError naming a bad one."""
    content = json.loads(path.read_text(encoding="utf-8"))
    entries = content.get("poses") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise ValueError('expected an object with a non-empty list "poses"')
    return [_read_pose(i, entry) for i, entry in enumerate(entries)]


def _read_pose(index: int, entry: object) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    import numpy as np

    if not isinstance(entry, dict):
        raise ValueError(f"poses[{index}]: expected an object")
    arrays = []
    for key, shape in (("q_rad", (7,)), ("flange_position_m", (3,)), ("flange_rotation", (3, 3))):
        if key not in entry:
            raise ValueError(f"poses[{index}]: {key} is missing")
        try:
            array = np.array(entry[key], dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"poses[{index}].{key}: not numbers") from error
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f"poses[{index}].{key}: expected {shape} finite numbers")
        arrays.append(array)
    if np.abs(arrays[2] @ arrays[2].T - np.eye(3)).max() > 1e-6 or np.linalg.det(arrays[2]) < 0:
        raise ValueError(f"poses[{index}].flange_rotation: not a rotation matrix")
    return arrays[0], arrays[1], arrays[2]


def _angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle [rad] between two rotations; exact for small ones, where arccos of the trace is not."""
    import numpy as np

    chord = float(np.linalg.norm(a - b)) / (2.0 * np.sqrt(2.0))  # sin(angle / 2)
    return float(2.0 * np.arcsin(min(chord, 1.0)))


def _print(result: dict[str, int | float], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(result))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("quantity", "value")
    for name, value in result.items():
        table.add_row(name, str(value) if isinstance(value, int) else f"{value:.4g}")
    Console().print(table)
