"""`codesign graph`: the ROS 2 graph as processes."""

import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(help="Start the ROS 2 graph, measure it.", no_args_is_help=True)


def bringup_command() -> list[str]:
    """The bring-up's executable.

    Raises:
        typer.Exit: code 2, with the remedy, when it is not on the path.
    """
    found = shutil.which("bringup")
    if found is None:
        typer.echo(
            "codesign: `bringup` is not on the path: run `make setup`, then `. scripts/env.sh`",
            err=True,
        )
        raise typer.Exit(2)
    return [found]


def run_process(command: list[str], *, apart: bool = False) -> int:
    """Runs a command to its end; on Ctrl-C waits until it has stopped what it started.

    Args:
        command: program and arguments.
        apart: on a DDS domain of its own (1..40), so that a graph that is already up on the
            usual one neither disturbs nor is disturbed.
    """
    domain = {"ROS_DOMAIN_ID": str(1 + os.getpid() % 40)} if apart else {}
    process = subprocess.Popen(command, env=os.environ | domain)
    while True:
        try:
            return process.wait()
        except KeyboardInterrupt:
            continue  # the child got the signal too, and stops its own


@app.command()
def up(
    profile: Annotated[str, typer.Argument(help="sim, real, or a YAML file")] = "sim",
    lockstep: Annotated[bool, typer.Option(help="simulated time, as fast as it goes")] = False,
) -> None:
    """Starts the graph and keeps it until Ctrl-C."""
    command = [*bringup_command(), profile] + (["--lockstep"] if lockstep else [])
    raise typer.Exit(run_process(command))


@app.command()
def bench(
    trials: Annotated[int, typer.Option(min=1, help="trials to record")] = 3,
    tetrahedra: Annotated[int, typer.Option(help="resolution of the block")] = 2400,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Measures latency and rates of the graph at real time.

    Brings the graph up, records trials, and reads the stamps in the bags. Other load on the
    machine is part of what is measured.
    """
    with tempfile.TemporaryDirectory(prefix="codesign-bench-") as folder:
        command = [
            *bringup_command(), "sim", "--log-folder", f"{folder}/logs", "--quiet",
            "--set", f"fem_simulator.tetrahedra={tetrahedra}",
            "--", "run_trials", "--count", str(trials), "--out", folder,
        ]  # fmt: skip
        code = run_process(command, apart=True)
        if code not in (0, 1):
            typer.echo(f"codesign graph bench: the graph ended with exit code {code}", err=True)
            raise typer.Exit(code)
        result = _summary(Path(folder))
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print_table(result)


def _summary(folder: Path) -> dict[str, Any]:
    import numpy as np

    from codesign_report.timing import graph_timing

    timings = [graph_timing(bag.parent) for bag in sorted(folder.glob("*/metadata.yaml"))]
    trials = json.loads((folder / "trials.json").read_text())["trials"]

    def percentiles(name: str) -> dict[str, float]:
        values = np.concatenate([getattr(t, name) for t in timings])
        p50, p99 = np.percentile(values, [50, 99])
        return {"p50": round(float(p50), 3), "p99": round(float(p99), 3)}

    names = ("action_to_command", "controller_period", "policy_period", "state_period")
    return {f"{name}_ms": percentiles(name) for name in names} | {
        "actions": int(sum(len(t.action_to_command) for t in timings)),
        "actions_lost": sum(t.actions_lost for t in timings),
        "trials": len(trials),
        "succeeded": sum(t["success"] for t in trials),
    }


def _print_table(result: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "p50 [ms]", "p99 [ms]", title="Graph at real time")
    for name, value in result.items():
        if isinstance(value, dict):
            table.add_row(
                name.removesuffix("_ms").replace("_", " "), str(value["p50"]), str(value["p99"])
            )
    Console().print(table)
    typer.echo(
        f"{result['actions']} actions, {result['actions_lost']} lost; "
        f"{result['succeeded']} of {result['trials']} trials succeeded"
    )
