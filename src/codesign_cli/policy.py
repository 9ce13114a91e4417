"""`codesign policy`: policies in the simulated control stage, and how fast they are learned."""

from __future__ import annotations

import json
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from codesign_cli import demonstrations, training

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from codesign_policy.rollout import Extremes, LanePolicy, Rollout

app = typer.Typer(help="Policies in the simulated control stage.", no_args_is_help=True)
app.command()(demonstrations.demonstrate)
app.command()(demonstrations.import_demonstrations)
app.command()(demonstrations.export_demonstrations)
for command in (
    training.train,
    training.finetune,
    training.evaluate,
    training.export,
    training.show,
):
    app.command()(command)

FASTEST = 5.0  # m/s; what lifts tofu at 0.2 m/s has no business being faster


class PolicyName(StrEnum):
    """Policies that can be rolled out."""

    scripted = "scripted"
    random = "random"


@app.command()
def rollout(
    policy: Annotated[PolicyName, typer.Option(help="Who acts.")] = PolicyName.scripted,
    envs: Annotated[int, typer.Option(min=1, help="Lanes; best a multiple of 8.")] = 8,
    processes: Annotated[int, typer.Option(min=1, help="Worker processes to spread over.")] = 1,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="How many; default: one per lane.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Control steps, all lanes together, instead.")
    ] = None,
    tets: Annotated[int, typer.Option(help="Resolution of the block: 600 or 2400.")] = 600,
    seed: Annotated[int, typer.Option(min=0, help="Lane i starts with seed + i.")] = 0,
    hold: Annotated[
        int, typer.Option(min=1, help="Random actions: steps that each is kept; more is rougher.")
    ] = 1,
    near: Annotated[
        bool, typer.Option("--near", help="Start with the fingers around the block.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Run a policy in many lanes; print success, stress, speed and the largest values seen.

    Lane i's first episode is the trial of seed + i that `codesign demo` runs over the graph.

    Exit codes: 0 done, 1 a block became faster than 5 m/s, 2 bad input, 3 the simulation failed.

    Examples:

      codesign policy rollout --episodes 50 --tets 2400

      codesign policy rollout --policy random --near --hold 10 --steps 10000000 --processes 2
    """
    from codesign_policy.env_pool import WorkerError
    from codesign_sim import SimulationError

    if steps is not None and episodes is not None:
        typer.echo("Give --steps or --episodes, not both.", err=True)
        raise typer.Exit(2)
    if steps is None and episodes is None:
        episodes = envs
    try:
        env = _environment(envs, processes, tets, near)
    except ValueError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from error
    try:
        actor = _actor(policy, env, seed, hold)
        result = _with_progress(env, actor, seed, steps, episodes)
    except (SimulationError, WorkerError) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(3) from error
    finally:
        env.close()
    _print(result, as_json)
    if result.extremes.object_speed > FASTEST:
        raise typer.Exit(1)


@app.command()
def bench(
    seconds: Annotated[
        float, typer.Option(min=0.1, help="CPU time per preset, after a warm-up of 2-4 s.")
    ] = 5.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Measure the learner: updates of the critics per CPU second for each preset, and a run's
    environment steps per second with the shares of simulation, updates and the rest. One thread.

    Example: codesign policy bench --json
    """
    from dataclasses import asdict

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.table import Table

    from codesign_policy.presets import PRESETS
    from codesign_policy.training_bench import measure_training
    from codesign_policy.update_bench import measure

    columns = (TextColumn("{task.description:>10}"), BarColumn(), TimeRemainingColumn())
    rates = []
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=len(PRESETS) + 1)
        for preset in PRESETS.values():
            progress.update(task, description=preset.name)
            rates.append(measure(preset, seconds))
            progress.advance(task)
        progress.update(task, description="training")
        training = measure_training()
    if as_json:
        results = {"rates": [asdict(rate) for rate in rates], "training": asdict(training)}
        typer.echo(json.dumps(results, indent=2))
        return
    table = Table("preset", "updates/CPU s", "CPU ms/update", "transitions/CPU s")
    for column in table.columns[1:]:
        column.justify = "right"
    for rate in rates:
        table.add_row(
            rate.preset,
            f"{rate.updates_per_cpu_second:.1f}",
            f"{rate.cpu_ms_per_update:.2f}",
            f"{rate.transitions_per_cpu_second:.1f}",
        )
    console = Console()
    console.print(table)
    console.print(
        f"co-design in {training.space}, {training.preset}, {training.lanes} lanes: "
        f"{training.environment_steps_per_second:.0f} environment steps/s; simulation "
        f"{training.simulation:.0%}, updates {training.updates:.0%}, rest {training.rest:.0%}"
    )


def _environment(envs: int, processes: int, tets: int, near: bool) -> VectorEnv:
    from codesign_policy.control_env import ControlConfig, ControlEnv
    from codesign_policy.env_pool import PooledControlEnv
    from codesign_policy.tool import ToolStart

    start = ToolStart(position=(0.45, 0.0, 0.02)) if near else ToolStart()
    config = ControlConfig(tetrahedra=tets, start=start)
    if processes == 1:
        return ControlEnv(envs, config=config)
    return PooledControlEnv(envs, processes, config=config)


def _actor(policy: PolicyName, env: VectorEnv, seed: int, hold: int) -> LanePolicy:
    from codesign_policy.rollout import RandomLanes, ScriptedLanes

    if policy is PolicyName.random:
        return RandomLanes(env.num_envs, seed, hold)
    return ScriptedLanes(env.fingers)  # type: ignore[attr-defined]


def _with_progress(
    env: VectorEnv, actor: LanePolicy, seed: int, steps: int | None, episodes: int | None
) -> Rollout:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    from codesign_policy.rollout import roll_out

    rounds = -(-(episodes or 0) // env.num_envs)
    total = steps or rounds * env.num_envs * env.config.episode_steps  # type: ignore[attr-defined]
    columns = (
        TextColumn("{task.completed:,} of {task.total:,} steps"),
        BarColumn(bar_width=20),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=Console(stderr=True), refresh_per_second=2) as progress:
        task = progress.add_task("", total=total)

        def show(done: int, extremes: Extremes) -> None:
            fastest = f"block {extremes.object_speed:.2f}, node {extremes.node_speed:.2f} m/s"
            progress.update(task, completed=min(done, total), description=f"fastest: {fastest}")

        return roll_out(env, actor, seed=seed, steps=steps, episodes=episodes, on_progress=show)


def _print(result: Rollout, as_json: bool) -> None:
    summary = result.summary()
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("quantity", "value")
    table.columns[1].justify = "right"
    for name, value in summary.items():
        if value is not None:
            table.add_row(name, f"{value:,}" if isinstance(value, int) else f"{value:,.4g}")
    Console().print(table)
