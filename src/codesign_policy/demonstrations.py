"""Demonstrations: for each expert finger its inverse design and one grasp that succeeds.

A file (.npz, arrays only, read without running code) holds the rows of a `ReplayBuffer` and, as
JSON, where they come from: 3 rows of the design stage and 600 of the control stage.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codesign_design.design_space import design_space
from codesign_design.experts import SCOOP_TIP, expert_surface
from codesign_design.inverse import FitOptions, fit
from codesign_policy.codesign_env import COMPONENTS, CodesignEnv, built_design
from codesign_policy.control_env import ControlConfig
from codesign_policy.domain import draw_domain
from codesign_policy.files import replacing
from codesign_policy.finger_plan import LEAST_LIP, plan_for
from codesign_policy.lanes import observation_space
from codesign_policy.replay import FIELDS, ReplayBuffer, Spaces, Transitions
from codesign_policy.rollout import ScriptedLanes
from codesign_policy.rounds import Episodes, Played, play_round
from codesign_policy.scripted import GraspPlan
from codesign_policy.simulated_fingers import lip
from codesign_policy.task import TASK_VERSION

EXPERTS = ("flat_pad", "cupped_pad", "scoop")
# Of an expert's outline, fits mind these places most, (2, 3) corners [m]: the scoop's lip.
REGIONS = {"scoop": np.array([[-0.035, -0.001, SCOOP_TIP - 0.004], [0.035, 0.012, SCOOP_TIP]])}
RESTARTS = 24  # of a fit
GAPS = 16  # that are tried
PAD_STEP, LIP_STEP = 2.5e-4, 1e-3  # m, between them: lips hold in a much wider range than pads
TIGHTER = {PAD_STEP: 8, LIP_STEP: 2}  # steps from the planned gap to the first one
SETTLE_TIME = 0.4  # s; with the script's 0.8 s slow closing would not leave 1 s to hold
METRICS = ("success", "top10_stress", "median_stress")

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of all work that is done, 0 to 1."""


class DemonstrationError(RuntimeError):
    """An expert's inverse design makes no fingers, or they do not pick the block up."""


@dataclass(frozen=True)
class Demonstration:
    """What one demonstration is; every one of them succeeds.

    Attributes:
        expert: whose finger.
        parameters: of its inverse design, (D,) in [-1, 1].
        chamfer: distance of the inverse design to the expert's surface [m].
        width: gap that the grasp closes to [m].
        top10_stress, median_stress: means over the interaction period [Pa].
        gaps_that_hold: of the `GAPS` tried around the planned one, how many succeeded.
    """

    expert: str
    parameters: tuple[float, ...]
    chamfer: float
    width: float
    top10_stress: float
    median_stress: float
    gaps_that_hold: int


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations of one design space and their transitions.

    Attributes:
        space: name of the design space.
        episodes: what they are.
        rows: transitions of both stages with `COMPONENTS`.
    """

    space: str
    episodes: tuple[Demonstration, ...]
    rows: ReplayBuffer

    @property
    def designs(self) -> NDArray[np.float64]:
        """The demonstrated designs, (n, D)."""
        return np.array([episode.parameters for episode in self.episodes])

    def save(self, path: Path) -> None:
        """Writes them to `path` (.npz), over what was there, in one go."""
        about = {
            "task_version": TASK_VERSION,
            "space": self.space,
            "cage_version": design_space(self.space).version,
            "components": list(self.rows.components),
            "episodes": [asdict(episode) for episode in self.episodes],
        }
        arrays = {name: getattr(self.rows.rows, name) for name in FIELDS}
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)


def load_demonstrations(path: Path) -> Demonstrations:
    """Reads and checks demonstrations.

    Raises:
        ValueError: no such file, a damaged one, another version of task or cage, other reward
            components, wrong shapes or types, or numbers that are not finite or out of range.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            about: dict[str, Any] = json.loads(str(file["about"]))
            state = {name: file[name] for name in FIELDS}
        episodes = tuple(
            Demonstration(**{**each, "parameters": tuple(each["parameters"])})
            for each in about["episodes"]
        )
        space = design_space(about["space"])
        mine = {
            "task_version": TASK_VERSION,
            "cage_version": space.version,
            "components": list(COMPONENTS),
        }
        wrong = [name for name, value in mine.items() if about[name] != value]
    except (OSError, KeyError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path}: not demonstrations ({error}); make them with `codesign policy demonstrate`"
        ) from error
    if wrong:
        raise ValueError(
            f"{path}: {wrong[0]} is {about[wrong[0]]}, this program's is {mine[wrong[0]]}; make "
            "them anew with `codesign policy demonstrate`"
        )
    rows = _buffer(space.name, len(state["in_control"]))
    try:
        rows.insert(Transitions(**state))
        _check_observations(rows)
        designs = np.array([episode.parameters for episode in episodes], np.float32)
        if not np.array_equal(rows.designs, designs):
            raise ValueError(
                f"{len(designs)} episodes for {len(rows.designs)} designs, or other designs"
            )
    except ValueError as error:
        raise ValueError(f"{path}: {error}; make it anew") from error
    return Demonstrations(space.name, episodes, rows)


def _check_observations(buffer: ReplayBuffer) -> None:
    box = observation_space(buffer.spaces.observation)
    for name in ("observation", "next_observation"):
        values = getattr(buffer.rows, name)
        outside = np.argwhere((values < box.low) | (values > box.high))
        if len(outside):
            row, column = (int(i) for i in outside[0])
            raise ValueError(
                f"{name}[{row}, {column}] is {values[row, column]}: it must be within "
                f"{box.low[column]}..{box.high[column]}"
            )


def _buffer(space: str, capacity: int) -> ReplayBuffer:
    design = design_space(space).parameter_count
    return ReplayBuffer(Spaces(8 + design, design, 7), COMPONENTS, capacity)


# ------------------------------------------------------------------- making them


def demonstrate(
    space: str,
    experts: Sequence[str] = EXPERTS,
    tetrahedra: int = 600,
    seed: int = 0,
    progress: Progress = lambda what, share: None,
) -> Demonstrations:
    """Fits every expert's finger in the space, finds its best gap and records one grasp of each.

    The grasp is the scripted one that suits the fitted finger; of `GAPS` around the planned one it
    closes to that with the least top-10 % stress among those that succeed, as do a step tighter
    and a step wider.

    Args:
        space: name of the design space.
        experts: names of experts.
        tetrahedra: resolution of the block.
        seed: of the fits and of the block.
        progress: told how far it is.

    Raises:
        ValueError: unknown space or expert.
        DemonstrationError: a fitted finger cannot be used, or a grasp does not succeed.
    """

    def part(what: str, number: int) -> Callable[[float], None]:
        return lambda share: progress(what, (number + share) / (2 * len(experts) + 1))

    config = ControlConfig(tetrahedra=tetrahedra, domain=draw_domain(seed))
    sweep = CodesignEnv(space, GAPS, config=config)
    fits, plans, holding = [], [], []
    for k, name in enumerate(experts):
        fits.append(_fitted(space, name, seed, part(f"fitting {name}", 2 * k)))
        part(f"grasping with {name}", 2 * k + 1)(0.0)
        plan, gaps = _best_plan(sweep, name, fits[-1][0], seed)
        plans.append(plan)
        holding.append(gaps)
    part("recording", 2 * len(experts))(0.0)
    rows = _buffer(space, len(experts) * (1 + config.episode_steps))
    env = CodesignEnv(space, len(experts), config=config)
    played = _play(env, np.array([parameters for parameters, _ in fits]), plans, seed, rows)
    metrics = played.metrics
    for k, name in enumerate(experts):
        if not metrics["success"][k]:
            raise DemonstrationError(f"{name} in {space}: the recorded grasp failed")
    episodes = tuple(
        Demonstration(
            expert=name,
            parameters=tuple(fits[k][0].tolist()),
            chamfer=fits[k][1],
            width=plans[k].width,
            top10_stress=float(metrics["top10_stress"][k]),
            median_stress=float(metrics["median_stress"][k]),
            gaps_that_hold=holding[k],
        )
        for k, name in enumerate(experts)
    )
    part("done", 2 * len(experts))(1.0)
    return Demonstrations(space, episodes, rows)


def _fitted(
    space: str, expert: str, seed: int, progress: Callable[[float], None]
) -> tuple[NDArray[np.float32], float]:
    """Parameters of an expert's inverse design in single precision, as stored, and its distance."""
    options = FitOptions(restarts=RESTARTS, seed=seed)
    found = fit(design_space(space), expert_surface(expert), options, REGIONS.get(expert), progress)
    return found.parameters.astype(np.float32), found.chamfer


def _best_plan(
    env: CodesignEnv, expert: str, design: NDArray[np.float32], seed: int
) -> tuple[GraspPlan, int]:
    """The plan with the best gap, and how many of the gaps succeed."""
    built = built_design(env.space, tuple(design.astype(np.float64).tolist()))
    if built.fingers is None:
        raise DemonstrationError(f"{expert} in {env.space}: {'; '.join(built.problems)}")
    try:
        plan = replace(plan_for(built.fingers), settle_time=SETTLE_TIME)
    except ValueError as error:
        raise DemonstrationError(f"{expert} in {env.space}: {error}") from error
    step = LIP_STEP if lip(built.fingers) > LEAST_LIP else PAD_STEP
    offsets = step * (np.arange(GAPS) - TIGHTER[step])
    widths = np.maximum(plan.width + offsets, built.fingers.min_width)
    plans = [replace(plan, width=round(float(width), 6)) for width in widths]
    rows = _buffer(env.space, len(plans) * (1 + env.config.episode_steps))
    played = _play(env, np.tile(design, (len(plans), 1)), plans, seed, rows)
    success = played.metrics["success"].astype(bool)
    safe = success[1:-1] & success[:-2] & success[2:]
    if not safe.any():
        raise DemonstrationError(
            f"{expert} in {env.space}: no gap from {1e3 * widths[0]:.2f} to "
            f"{1e3 * widths[-1]:.2f} mm lifts the block, with a margin of {1e3 * step:g} mm: fit "
            "it in another space"
        )
    stress = np.where(safe, played.metrics["top10_stress"][1:-1], np.inf)
    return plans[1 + int(stress.argmin())], int(success.sum())


def _play(
    env: CodesignEnv,
    designs: NDArray[np.float32],
    plans: list[GraspPlan],
    seed: int,
    rows: ReplayBuffer,
) -> Played:
    """One scripted grasp in every lane."""
    env.reset(seed=seed, options={"designs": designs})  # so that the fingers are known
    script = ScriptedLanes(env.fingers, plans)
    episodes = Episodes(env, COMPONENTS, METRICS, env.design_observation)
    return play_round(episodes, seed, script.act, rows, designs)  # type: ignore[arg-type]
