"""`codesign policy train`, `finetune`, `evaluate`, `export` and `show`."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from codesign_policy.evaluation import Evaluation
    from codesign_policy.policy_file import TrainedPair
    from codesign_policy.run import RunConfig
    from codesign_policy.training import Progress, Training

INTERRUPTED = 130
LINE_PERIOD = 30.0  # s, between lines of progress where there is no terminal

OutOption = Annotated[Path, typer.Option(help="Folder of the run.")]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Go on with the run in --out.")]
TransitionsOption = Annotated[int, typer.Option(min=1, help="Control steps to learn from.")]
SeedOption = Annotated[int, typer.Option(min=0, help="Of everything that is drawn.")]
LanesOption = Annotated[int, typer.Option(min=1, help="Environments; best a multiple of 8.")]
QuietOption = Annotated[bool, typer.Option("--quiet", help="No progress.")]


def train(
    out: OutOption,
    space: Annotated[
        str, typer.Option(help="Design space, or 'stock': the stock fingers, control alone.")
    ] = "wide-12",
    preset: Annotated[str, typer.Option(help="fast or published.")] = "fast",
    designs: Annotated[
        str, typer.Option(help="From 'search' (CMA-ES) or the 'actor' (the paper's).")
    ] = "search",
    design_observation: Annotated[
        str,
        typer.Option(
            help="d, what is observed of the design: 'full', or 'scalar' as in the paper: its "
            "component in the direction in which demonstrated designs differ most."
        ),
    ] = "full",
    transitions: TransitionsOption = 80_000,
    seed: SeedOption = 0,
    lanes: LanesOption = 16,
    demonstrations: Annotated[
        Path | None, typer.Option(help="Folder of `policy demonstrate`; default: the shipped ones.")
    ] = None,
    without_demonstrations: Annotated[
        bool, typer.Option("--without-demonstrations", help="Online experience alone.")
    ] = False,
    practice: Annotated[
        int,
        typer.Option(
            min=0,
            help="More grasps of the expert, with fingers around the demonstrated ones, or with "
            "the stock ones. 0 as in the paper.",
        ),
    ] = 32,
    resume: ResumeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Learn a finger and its control together by RLPD, or control of the stock fingers.

    The run ends with judging candidate designs at 2,400 tetrahedra, and writes policy.npz. Ctrl-C
    saves and ends it; --resume goes on as if it had never stopped.

    Exit codes: 0 done, 1 learning or a demonstration failed, 2 bad input, 3 the simulation
    failed, 130 interrupted.

    Examples:

      codesign policy train --out runs/codesign

      codesign policy train --space stock --out runs/original
    """
    from codesign_policy.presets import PRESETS
    from codesign_policy.run import RunConfig

    with _errors("train"):
        if preset not in PRESETS or designs not in ("search", "actor"):
            raise ValueError(
                f"preset {preset!r}, designs from {designs!r}: presets are {', '.join(PRESETS)}; "
                "designs come from search or actor"
            )
        if design_observation not in ("full", "scalar"):
            raise ValueError(f"design observation {design_observation!r}: full or scalar")
        config = RunConfig(
            space="" if space == "stock" else space,
            preset=preset,
            search=designs == "search",
            transitions=transitions,
            seed=seed,
            lanes=lanes,
            command=shlex.join(["codesign", *sys.argv[1:]]),
            commit=_commit(),
        )
        if resume:
            training, config = _resumed(out, transitions)
        else:
            _require_new(out)
            training, config = _started(
                config,
                demonstrations,
                without_demonstrations,
                design_observation == "scalar",
                practice,
            )
            training.clone_demonstrations()
            config.save(out)
        _run(training, config, out, quiet)


def finetune(
    run: Annotated[Path, typer.Argument(help="Folder of the run to go on from.")],
    out: OutOption,
    transitions: TransitionsOption = 40_000,
    tets: Annotated[int, typer.Option(help="Resolution of the block: 600 or 2400.")] = 2400,
    stress_factor: Annotated[
        float, typer.Option(min=0.0, help="On the weight of stress in the reward.")
    ] = 5.0,
    lift_factor: Annotated[
        float,
        typer.Option(
            min=0.0, help="On the weights of lifting and of being up: a low one leaves time."
        ),
    ] = 0.5,
    expert: Annotated[
        bool, typer.Option(help="Whether the expert demonstrates as well, with these fingers.")
    ] = True,
    discount: Annotated[
        float,
        typer.Option(
            min=0.0, max=0.9999, help="Per control step; 0 for the preset's. A high one is patient."
        ),
    ] = 0.995,
    seed: SeedOption = 0,
    lanes: LanesOption = 16,
    resume: ResumeOption = False,
    quiet: QuietOption = False,
) -> None:
    """Fine-tune a run's control with its design fixed (paper, III-D).

    The demonstrations are the gentlest of the policy's own episodes and of the expert's with these
    fingers. Stress weighs more, being up less.

    Exit codes: as of `train`.

    Example: codesign policy finetune runs/codesign --out runs/codesign-tuned
    """
    from codesign_policy.control_demonstrations import gentlest_rows, own_rows
    from codesign_policy.run import load_run, make_training

    with _errors("finetune"):
        if resume:
            training, config = _resumed(out, transitions)
        else:
            _require_new(out)
            source = load_run(run)
            agent = _trained(run, source).agent
            design = tuple(float(value) for value in _pair(run).design)
            config = replace(
                source,
                design=design,
                transitions=transitions,
                tetrahedra=tets,
                stress_factor=stress_factor,
                lift_factor=lift_factor,
                discount=discount,
                seed=seed,
                lanes=lanes,
                command=shlex.join(["codesign", *sys.argv[1:]]),
                commit=_commit(),
            )
            rows = gentlest_rows(agent, config) if expert else own_rows(agent, config)
            config = replace(config, demonstrations=len(rows))
            training = make_training(config, rows, agent)
            training.clone_demonstrations()
            config.save(out)
        _run(training, config, out, quiet)


def evaluate(
    checkpoint: Annotated[
        str, typer.Option(help="Name of a shipped pair, a policy.npz or the folder of a run.")
    ] = "codesign",
    episodes: Annotated[int, typer.Option(min=2, help="How many.")] = 50,
    tets: Annotated[int, typer.Option(help="Resolution of the block: 600 or 2400.")] = 2400,
    friction: Annotated[float | None, typer.Option(help="Fixed; default: 0.5.")] = None,
    pose_error: Annotated[
        float, typer.Option(help="Of the observed object, horizontally [mm].")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the first episode.")] = 1000,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Judge a trained pair: success, stress and score over episodes it was not trained on.

    Exit codes: 0 done, 2 bad input, 3 the simulation failed.

    Examples:

      codesign policy evaluate --checkpoint codesign --episodes 50 --tets 2400 --json

      codesign policy evaluate --checkpoint runs/codesign --friction 0.4 --pose-error 2
    """
    from codesign_policy.control_env import ControlConfig
    from codesign_policy.domain import FRICTION
    from codesign_policy.evaluation import evaluate as judge

    with _errors("evaluate"):
        drawn = FRICTION if friction is None else friction
        config = ControlConfig(
            tetrahedra=tets, friction=(drawn, drawn), pose_error=1e-3 * pose_error
        )
        pair = _pair(checkpoint)
        with _bar("evaluating") as show:
            total = -(-episodes // 8) * 8 * config.episode_steps
            found = judge(
                pair, episodes, config, seed, lambda done, extremes: show("", done / total)
            )
    if as_json:
        typer.echo(json.dumps(found.as_json(), indent=2))
    else:
        _print_evaluation(checkpoint, found)


def export(
    checkpoint: Annotated[
        str, typer.Argument(help="Folder of a run, a policy.npz or a shipped pair's name.")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write, over what was there.")],
) -> None:
    """Write a trained pair with all files of its finger: to print it, to serve it, to ship it.

    Exit codes: 0 done, 2 bad input, or a finger that cannot be printed or used.

    Example: codesign policy export runs/codesign-tuned --out my-finger
    """
    from codesign_policy.shipped import ship

    with _errors("export"):
        ship(_pair(checkpoint), out)
    typer.echo(f"pair: {out}")


def show(
    runs: Annotated[list[Path], typer.Argument(help="Folders of runs, drawn together.")],
    out: Annotated[Path | None, typer.Option(help="Picture of the curves (PNG).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Show runs: settings, how far they are, their last rounds, and a picture of the curves.

    Exit codes: 0 done, 2 no such run.

    Example: codesign policy show runs/codesign-* --out runs/curves.png
    """
    from codesign_policy.curves import draw_curves, moving_mean, read_history
    from codesign_policy.run import load_run

    with _errors("show"):
        histories = {folder.name: read_history(folder) for folder in runs}
        rows: list[dict[str, Any]] = []
        for folder in runs:
            config, history = load_run(folder), histories[folder.name]
            last: dict[str, Any] = {
                name: float(moving_mean(history[name])[-1])
                for name in ("success", "top10_stress", "median_stress", "episode_return")
                if name in history
            }
            rows.append(
                {
                    "run": folder.name,
                    "fingers": config.space or "stock",
                    "seed": config.seed,
                    "transitions": int(history["transitions"][-1]),
                    "budget": config.transitions,
                    **last,
                    "finished": (folder / "policy.npz").is_file(),
                    "command": config.command,
                }
            )
        picture = out or runs[0] / "curves.png"
        draw_curves(histories, picture)
    if as_json:
        typer.echo(json.dumps({"runs": rows, "picture": str(picture)}, indent=2))
        return
    from rich.console import Console
    from rich.table import Table

    shown = [name for name in rows[0] if name != "command"]
    table = Table(*(name.replace("_", " ") for name in shown))
    for row in rows:
        values = (row.get(name, "") for name in shown)
        table.add_row(*(f"{v:.4g}" if isinstance(v, float) else str(v) for v in values))
    console = Console()
    console.print(table)
    console.print(f"curves: {picture}")


# ------------------------------------------------------------------------ starting


def _started(
    config: RunConfig, source: Path | None, without: bool, scalar: bool, practice: int
) -> tuple[Training, RunConfig]:
    """A new run with its demonstrations."""
    from codesign_policy.control_demonstrations import expert_rows, nominal_rows
    from codesign_policy.expert_demonstrations import practise
    from codesign_policy.proposals import SearchSettings
    from codesign_policy.replay import joined
    from codesign_policy.run import make_training, principal_direction, shown_rows

    if scalar and (without or not config.space):
        raise ValueError("a scalar d comes from demonstrated designs: give a space and these")
    if without:
        return make_training(config, None), config
    if config.space:
        shown = shown_rows(config.space, source)
        config = replace(config, start=shown.gentlest.parameters)
        if scalar:
            config = replace(config, design_direction=principal_direction(shown.designs))
        rows = shown.rows
        if practice:
            spread = SearchSettings().spread
            more = practise(shown, practice, config.control(), spread, config.seed)
            rows = joined(rows, rows.rows, more)
    else:
        rows = nominal_rows(config)
        if practice:
            rows = joined(rows, rows.rows, expert_rows(config, practice).rows)
    config = replace(config, demonstrations=len(rows))
    return make_training(config, rows), config


def _resumed(folder: Path, transitions: int) -> tuple[Training, RunConfig]:
    """The run in a folder, where it stopped; the budget may be another."""
    from codesign_policy.run import load_run

    config = replace(load_run(folder), transitions=transitions)
    return _trained(folder, config), config


def _trained(folder: Path, config: RunConfig) -> Training:
    """A run as its checkpoint holds it."""
    from codesign_policy.checkpoint import load_checkpoint
    from codesign_policy.codesign_env import COMPONENTS
    from codesign_policy.replay import ReplayBuffer
    from codesign_policy.run import make_training

    checkpoint = load_checkpoint(folder)
    stored = checkpoint.state["demonstrations"]
    rows = None
    if stored is not None:
        rows = ReplayBuffer(config.spaces, COMPONENTS, config.demonstrations)
        rows.restore(stored)
    training = make_training(config, rows)
    training.restore(checkpoint)
    return training


def _require_new(folder: Path) -> None:
    if (folder / "run.json").exists():
        raise ValueError(f"{folder}: holds a run: give --resume to go on, or another --out")


def _commit() -> str:
    """Of the checkout that this program runs from; empty if it is none."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip()


# ------------------------------------------------------------------------- running


def _run(training: Training, config: RunConfig, out: Path, quiet: bool) -> None:
    """Trains, and ends a run that used its budget up."""
    import torch

    from codesign_policy.curves import draw_curves, read_history
    from codesign_policy.interruption import Interruption
    from codesign_policy.tensorboard_log import TensorBoardLog

    torch.set_num_threads(1)
    with (
        Interruption() as interrupted,
        TensorBoardLog(out / "tensorboard", training.transitions) as log,
        _bar("training", quiet) as shown,
    ):

        def on_round(progress: Progress) -> None:
            log(progress)
            shown(_words(progress), progress.transitions / progress.budget)

        training.run(out, on_round, interrupted)
    draw_curves({out.name: read_history(out)}, out / "curves.png")
    if not training.done:
        typer.echo(f"stopped after {training.transitions} transitions: go on with --resume")
        raise typer.Exit(INTERRUPTED)
    _finish(training, config, out, quiet)


def _finish(training: Training, config: RunConfig, out: Path, quiet: bool) -> None:
    """Chooses the design where it was learned, and writes the pair."""
    import numpy as np

    from codesign_policy.files import write_text
    from codesign_policy.selection import select_design

    training.recall_best()
    design = config.design
    if config.learns_design:
        with _bar("judging designs", quiet) as shown:
            judged = select_design(training, config, lambda share: shown("", share))
        table = {"candidates": [candidate.as_json() for candidate in judged]}
        write_text(out / "selection.json", json.dumps(table, indent=2) + "\n")
        design = judged[0].design
    about = {
        "space": config.space,
        "tetrahedra": config.tetrahedra,
        "seed": config.seed,
        "transitions": training.transitions,
        "command": config.command,
        "commit": config.commit,
    }
    training.agent.pair(np.array(design), about).save(out / "policy.npz")
    _draw_finger(config.space, np.array(design), out / "finger.png")
    typer.echo(f"pair: {out / 'policy.npz'}")


def _draw_finger(space: str, design: NDArray[np.float64], path: Path) -> None:
    """A picture of the finger that a run has ended with."""
    from codesign_design.design_space import design_space
    from codesign_design.pictures import design_picture, finger_picture, save
    from codesign_design.stock import stock_fingers

    save(
        design_picture(design_space(space), design)
        if space
        else finger_picture(stock_fingers().left),
        path,
    )


def _words(progress: Progress) -> str:
    known = progress.metrics
    stress = "".join(
        f", {word} {known[name]:.0f} Pa"
        for name, word in (("top10_stress", "top-10 %"), ("median_stress", "median"))
        if name in known
    )
    return (
        f"return {progress.episode_return:.0f}, success {known.get('success', 0.0):.2f}{stress}, "
        f"{progress.transitions:,} of {progress.budget:,} transitions"
    )


def _pair(name: str | Path) -> TrainedPair:
    from codesign_policy.policy_file import load_pair
    from codesign_policy.shipped import checkpoint_path

    return load_pair(checkpoint_path(name))


# ------------------------------------------------------------------------- showing


@contextmanager
def _bar(what: str, quiet: bool = False) -> Iterator[Callable[[str, float], None]]:
    """A progress bar with the time left; lines now and then where there is no terminal."""
    import time

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        last = time.monotonic()

        def line(words: str, share: float) -> None:
            nonlocal last
            if not quiet and (time.monotonic() - last > LINE_PERIOD or share >= 1.0):
                last = time.monotonic()
                typer.echo(f"{what}: {100 * share:.0f} % {words}", err=True)

        yield line
        return
    columns = (TextColumn("{task.fields[what]}"), BarColumn(bar_width=20), TimeRemainingColumn(),
               TextColumn("{task.description}"))  # fmt: skip
    with Progress(*columns, console=console, refresh_per_second=2) as progress:
        task = progress.add_task("", total=1.0, what=what)
        yield lambda words, share: progress.update(task, description=words, completed=share)


def _print_evaluation(name: str, found: Evaluation) -> None:
    from rich.console import Console
    from rich.table import Table

    def interval(pair: tuple[float, float] | None, digits: int) -> str:
        return "" if pair is None else f"{pair[0]:.{digits}f} .. {pair[1]:.{digits}f}"

    def value(number: float | None) -> str:
        return "never touched" if number is None else f"{number:.0f} Pa"

    table = Table("quantity", "mean", "95 % interval", title=f"{name}, {found.episodes} episodes")
    table.add_row("success", f"{found.success_rate:.2f}", interval(found.success_interval, 2))
    table.add_row(
        "top-10 % stress", value(found.top10_stress_pa), interval(found.top10_interval, 0)
    )
    table.add_row(
        "median stress", value(found.median_stress_pa), interval(found.median_interval, 0)
    )
    table.add_row("score", f"{found.score:.1f}", "")
    Console().print(table)


@contextmanager
def _errors(command: str) -> Iterator[None]:
    """What can go wrong, as exit codes."""
    from codesign_policy.expert_plan import DemonstrationError
    from codesign_policy.rlpd import LearningError
    from codesign_sim import SimulationError

    try:
        yield
    except (DemonstrationError, LearningError) as error:
        typer.echo(f"{command}: {error}", err=True)
        raise typer.Exit(1) from None
    except (ValueError, OSError) as error:
        typer.echo(f"{command}: {error}", err=True)
        raise typer.Exit(2) from None
    except SimulationError as error:
        typer.echo(f"{command}: {error}", err=True)
        raise typer.Exit(3) from None
