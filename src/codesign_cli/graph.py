"""`codesign graph`: the ROS 2 graph as processes."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(help="Start the ROS 2 graph, measure it.", no_args_is_help=True)

# Name in the result, servo points [Hz], SCHED_FIFO.
SERVO_CASES = (
    ("servo_lateness_100_hz_ms", 100, False),
    ("servo_lateness_250_hz_fifo_ms", 250, True),
)
FAKE_BOX_PRIORITY = 60  # of 1..99


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
    servo_seconds: Annotated[
        float, typer.Option(min=0.0, help="of streaming at each rate; 0: leave it out")
    ] = 30.0,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Measures latency and rates of the graph at real time.

    Brings the graph up, records trials, and reads the stamps in the bags. Then xarm_driver streams
    to the fake control box of this checkout beside the running simulator, at 100 Hz and at 250 Hz
    with SCHED_FIFO where permitted, and the lateness of its wake-ups is taken. Other load on the
    machine is part of what is measured.
    """
    if servo_seconds:
        fake_box_folder()  # what is missing is said first
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
    for name, rate, realtime in SERVO_CASES if servo_seconds else ():
        result[name] = measure_servo(rate, realtime, servo_seconds, tetrahedra)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print_table(result)


def fake_box_folder() -> Path:
    """The checkout that holds the fake control box.

    Raises:
        typer.Exit: code 2, with the remedy, when this is no checkout.
    """
    root = Path(__file__).parents[2]
    if not (root / "tests" / "fake_box" / "__main__.py").exists():
        typer.echo(
            "codesign graph bench: the fake control box is in the repository's tests/: run it from "
            "a checkout, or give --servo-seconds 0",
            err=True,
        )
        raise typer.Exit(2)
    return root


def measure_servo(rate: int, realtime: bool, seconds: float, tetrahedra: int) -> dict[str, Any]:
    """Streams to a fake control box beside the simulator; the figures, rounded [ms].

    Raises:
        typer.Exit: the graph or the driver did not get that far.
    """
    from codesign_report.timing import servo_timing

    number = os.getpid() % 60_000
    address = f"127.{1 + number // 250}.{number % 250}.9"
    box = subprocess.Popen(
        [sys.executable, "-m", "tests.fake_box", "--address", address, "--log", os.devnull],
        cwd=fake_box_folder(),
        preexec_fn=_before_all,
    )
    try:
        with tempfile.TemporaryDirectory(prefix="codesign-bench-") as folder:
            out = Path(folder, "servo.json")
            command = [
                *bringup_command(), "sim", "--log-folder", f"{folder}/logs", "--quiet",
                "--set", f"fem_simulator.tetrahedra={tetrahedra}",
                "--", sys.executable, "-m", "codesign_bringup.servo_bench", "--address", address,
                "--rate", str(rate), "--seconds", str(seconds), "--out", str(out),
                *(["--realtime"] if realtime else []),
            ]  # fmt: skip
            code = run_process(command, apart=True)
            if code:
                typer.echo(f"codesign graph bench: streaming ended with code {code}", err=True)
                raise typer.Exit(code)
            timing = servo_timing(json.loads(out.read_text()))
    finally:
        box.kill()
        box.wait()
    return {k: round(v, 3) if isinstance(v, float) else v for k, v in asdict(timing).items()}


def _before_all() -> None:
    """A control box waits for nobody: where permitted, it goes before everything else here."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FAKE_BOX_PRIORITY))


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

    table = Table("", "p50 [ms]", "p99 [ms]", "max [ms]", title="Graph at real time")
    for name, value in result.items():
        if isinstance(value, dict):
            table.add_row(
                name.removesuffix("_ms").replace("_", " "),
                str(value["p50"]),
                str(value["p99"]),
                str(value.get("max", "")),
            )
    Console().print(table)
    typer.echo(
        f"{result['actions']} actions, {result['actions_lost']} lost; "
        f"{result['succeeded']} of {result['trials']} trials succeeded"
    )
