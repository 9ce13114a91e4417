"""`codesign demo`: trials over the graph, then videos and a report."""

import json
import os
import shutil
from pathlib import Path
from typing import Annotated, Any

import typer

from codesign_cli.graph import bringup_command, run_process

BAD_INPUT = 2
DEFAULT_POLICIES = ["codesign", "original"]  # the pairs that come with the package
CAMERA_POLICIES = ["scripted"]  # pictures of the block between lips are found too rarely
CAMERA_TIMEOUT = 900.0  # s per trial: rendering and looking take a while on a busy machine


def demo(
    out: Annotated[Path, typer.Option(help="folder of the results; replaced")] = Path("runs/demo"),
    trials: Annotated[int, typer.Option(min=1, help="how many of each policy")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="of the first trial; then one up each")] = 0,
    tetrahedra: Annotated[int, typer.Option(help="resolution of the block: 600 or 2400")] = 2400,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="scripted, a shipped pair or a checkpoint's path; may be repeated; default: "
            "codesign and original, with --camera scripted"
        ),
    ] = None,
    real_time: Annotated[
        bool,
        typer.Option("--real-time", help="on the wall clock; default: simulated time, repeatable"),
    ] = False,
    camera: Annotated[
        bool,
        typer.Option(
            "--camera", help="the policy sees the block through a rendered camera only; slower"
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print summary.json at the end")] = False,
) -> None:
    """Picks up silk tofu over the ROS 2 graph and writes a report.

    By default the co-designed pair that comes with the package and the original gripper's policy.
    Every policy gets the same seeds; the report shows them side by side. A trained pair brings its
    own fingers, the scripted grasp takes those that are mounted, at first the stock ones.

    Exit codes: 0 every trial succeeded, 1 one failed, 2 bad input, 3 the graph broke down.

    Examples:

      codesign demo --policy scripted --trials 5 --seed 10

      codesign demo --policy runs/mine --policy runs/original

      codesign demo --camera
    """
    bringup = bringup_command()
    policies = policy or (CAMERA_POLICIES if camera else DEFAULT_POLICIES)
    names = _policy_options(policies)
    part = _empty_folder(out)
    profile = "sim_camera" if camera else "sim"
    command = [*bringup, profile, "--log-folder", str(part / "logs"), "--quiet"]
    command += ["--set", f"fem_simulator.tetrahedra={tetrahedra}"]
    command += [] if real_time else ["--lockstep"]
    command += ["--", "run_trials", "--count", str(trials), "--seed", str(seed), "--out", str(part)]
    command += ["--timeout", str(CAMERA_TIMEOUT)] if camera else []
    command += names
    code = run_process(command, apart=True)
    if code not in (0, 1):
        typer.echo(
            f"codesign demo: the graph ended with exit code {code}: see {part}/logs", err=True
        )
        raise typer.Exit(code)
    _report(part)
    _replace(part, out)
    summary = json.loads((out / "summary.json").read_text())
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        _print_table(summary)
        typer.echo(f"report: {out / 'report.html'}")
    outcomes = [trial["success"] for trial in summary["trials"]]
    failed = len(outcomes) < trials * len(policies) or not all(outcomes)
    raise typer.Exit(1 if failed else code)


def _policy_options(policies: list[str]) -> list[str]:
    """For run_trials; the scripted grasp alone is what the graph serves already."""
    from codesign_policy.policy import SCRIPTED, policy_label, policy_names, trained_pair

    try:
        for name in policies:
            trained_pair(name)
        labels = [policy_label(name) for name in policies]
        if len(set(labels)) < len(labels):
            raise ValueError(f"policies {', '.join(policies)}: two would be labelled the same")
    except ValueError as error:
        typer.echo(f"codesign demo: {error}", err=True)
        raise typer.Exit(BAD_INPUT) from None
    if policies == [SCRIPTED]:
        return []
    known = policy_names()
    paths = [name if name in known else str(Path(name).resolve()) for name in policies]
    return [part for path in paths for part in ("--policy", path)]


def _empty_folder(out: Path) -> Path:
    """A folder beside `out` to work in: an earlier result stays until the new one is whole."""
    if out.exists() and any(out.iterdir()) and not (out / "summary.json").exists():
        typer.echo(
            f"codesign demo: {out} is not empty and no run of ours: choose another", err=True
        )
        raise typer.Exit(BAD_INPUT)
    part = out.with_name(f"{out.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    return part


def _replace(part: Path, out: Path) -> None:
    old = out.with_name(f"{out.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if out.exists():
        os.replace(out, old)
    os.replace(part, out)
    shutil.rmtree(old, ignore_errors=True)


def _report(folder: Path) -> None:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    import codesign_report

    columns = (TextColumn("{task.description}"), BarColumn(bar_width=30), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("videos and report")
        codesign_report.build(
            folder,
            progress=lambda done, total, name: progress.update(
                task, completed=done, total=total, description=f"videos: {name}"
            ),
            processes=len(os.sched_getaffinity(0)),
        )


def _print_table(summary: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title="Silk tofu pick-up")
    columns = ["gripper", "seed", "success", "top-10 % stress [Pa]", "median [Pa]", "lift [mm]"]
    seen = any("camera" in trial for trial in summary["trials"])
    if seen:
        columns += ["camera off [mm]", "95 %", "rejected"]
    for column in columns:
        table.add_column(column, justify="right")
    for trial in summary["trials"]:
        table.add_row(
            trial["gripper"],
            str(trial["seed"]),
            "yes" if trial["success"] else "NO",
            _number(trial["top10_stress_pa"], ".0f"),
            _number(trial["median_stress_pa"], ".0f"),
            f"{trial['peak_lift_m'] * 1e3:.1f}",
            *(_camera_columns(trial) if seen else []),
        )
    Console().print(table)
    for gripper in summary["grippers"]:
        if gripper["baseline"]:
            typer.echo(
                f"{gripper['gripper']} over {gripper['baseline']}: "
                f"{_number(gripper['top10_ratio'], '.2f')} of the top-10 % stress, "
                f"{_number(gripper['median_ratio'], '.2f')} of the median"
            )


def _camera_columns(trial: dict[str, Any]) -> list[str]:
    camera = trial.get("camera")
    if camera is None:
        return ["-"] * 3
    pictures = camera["pictures_used"] + camera["pictures_rejected"]
    return [
        f"{camera['pose_error_median_m'] * 1e3:.2f}",
        f"{camera['pose_error_p95_m'] * 1e3:.2f}",
        f"{camera['pictures_rejected']} of {pictures}",
    ]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
