"""`codesign bag ...`: recorded trials."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

if TYPE_CHECKING:
    from codesign_report.replay import Replay

app = typer.Typer(help="Recorded trials (rosbag2, MCAP).", no_args_is_help=True)

Bag = Annotated[Path, typer.Argument(help="rosbag2 folder or .mcap file of one trial.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]


@app.command()
def metrics(bag: Bag, as_json: AsJson = False) -> None:
    """Print the grasp metrics of a recorded trial.

    Success comes from stress and forces where they were simulated, else from the block's pose and
    the gripper.
    """
    from codesign_report.bag_outcome import read_outcome

    try:
        outcome = read_outcome(bag)
    except ValueError as error:
        fail(error)
    values = asdict(outcome.metrics)
    if as_json:
        label = {"gripper": outcome.gripper, "seed": outcome.seed}
        told = label | {"stress_known": outcome.stress_known} | values
        print(json.dumps({key: _or_null(value) for key, value in told.items()}))
        return
    found = outcome.metrics
    _print_rows(
        f"{outcome.gripper}, seed {outcome.seed}",
        [
            ("picked up", "yes" if found.success else "no"),
            ("judged by", "stress and forces" if outcome.stress_known else "pose and gripper"),
            ("top-10 % stress", _quantity(found.top10_stress, 0, "Pa")),
            ("median stress", _quantity(found.median_stress, 0, "Pa")),
            ("peak lift", _quantity(1e3 * found.peak_lift, 1, "mm")),
            ("held force", _quantity(found.held_force, 3, "N")),
            ("weight", _quantity(outcome.weight, 3, "N")),
            ("interaction", _quantity(found.interaction_time, 2, "s")),
            ("score", _quantity(found.score, 1, "")),
        ],
    )


@app.command()
def replay(bag: Bag, as_json: AsJson = False) -> None:
    """Feed the recorded observations to the recorded policy and compare its actions, bit by bit.

    Exit codes: 0 all actions are the same, 1 one is not, 2 the bag does not tell.
    """
    from codesign_report.replay import replay as replayed

    try:
        result = replayed(bag)
    except ValueError as error:
        fail(error)
    if as_json:
        print(json.dumps(_replay_values(result)))
    else:
        _print_rows(str(bag), _replay_rows(result))
    raise typer.Exit(0 if result.identical else 1)


@app.command()
def recover(
    bag: Annotated[Path, typer.Argument(help="What a killed recorder or a full disk left.")],
    out: Annotated[Path, typer.Argument(help="Folder of the new bag; must not exist.")],
) -> None:
    """Save the messages of a bag that was cut off as a whole bag."""
    from codesign_report.bag_recovery import recover as recovered

    try:
        count = recovered(bag, out)
    except ValueError as error:
        fail(error)
    except OSError as error:
        fail(error, code=1)
    print(f"{out}: {count} messages")


def fail(error: Exception, code: int = 2) -> NoReturn:
    """One line, no traceback."""
    typer.echo(f"error: {' '.join(str(error).split())}", err=True)
    raise typer.Exit(code)


def _replay_values(result: "Replay") -> dict[str, Any]:
    first = asdict(result.first) if result.first else None
    return {
        "identical": result.identical,
        "actions": result.actions,
        "equal": result.equal,
        "unknown": result.unknown,
        "largest_difference": _or_null(result.largest),
        "first_difference": first and {key: _or_null(value) for key, value in first.items()},
        "policies": [{"policy": name, "sha256": sha or None} for name, sha in result.policies],
    }


def _replay_rows(result: "Replay") -> list[tuple[str, str]]:
    rows = [("policy", f"{name} {sha[:12]}".strip()) for name, sha in result.policies]
    rows += [
        ("actions", str(result.actions)),
        ("equal", str(result.equal)),
        ("verdict", "the same, bit for bit" if result.identical else "DIFFERENT"),
    ]
    if result.unknown:
        rows.append(("cut off", f"{result.unknown} more actions, whose observations are missing"))
    if result.first is not None:
        first = result.first
        rows += [
            ("first difference", f"action {first.sequence}, {first.component}"),
            ("recorded", repr(first.recorded)),
            ("replayed", repr(first.replayed)),
            ("largest", f"{result.largest:.3g} m or rad"),
        ]
    return rows


def _or_null(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _quantity(value: float, decimals: int, unit: str) -> str:
    return f"{value:.{decimals}f} {unit}".strip() if math.isfinite(value) else "-"


def _print_rows(title: str, rows: list[tuple[str, str]]) -> None:
    print(title)
    for label, value in rows:
        print(f"  {label:<16} {value}")
