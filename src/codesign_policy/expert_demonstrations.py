"""Making demonstrations: each expert's inverse design, and the best scripted grasp with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codesign_design.design_space import design_space
from codesign_design.experts import SCOOP_TIP, expert_surface
from codesign_design.inverse import FitOptions, fit
from codesign_policy.codesign_env import COMPONENTS, CodesignEnv, built_design
from codesign_policy.control_env import ControlConfig
from codesign_policy.demonstrations import Demonstration, Demonstrations, empty_rows
from codesign_policy.domain import draw_domain
from codesign_policy.finger_plan import LEAST_LIP, plan_for
from codesign_policy.replay import ReplayBuffer
from codesign_policy.rollout import ScriptedLanes
from codesign_policy.rounds import Episodes, Played, play_round
from codesign_policy.scripted import GraspPlan
from codesign_policy.simulated_fingers import lip

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
    rows = empty_rows(space, len(experts) * (1 + config.episode_steps))
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
    return Demonstrations(space, episodes, _by_episode(rows, len(experts)))


def _by_episode(rows: ReplayBuffer, lanes: int) -> ReplayBuffer:
    """Rows that were stored step by step, lane by lane, one episode after the other."""
    order = np.arange(len(rows)).reshape(-1, lanes).T.ravel()
    sorted_rows = ReplayBuffer(rows.spaces, rows.components, rows.capacity)
    sorted_rows.insert(rows.rows.pick(order))
    return sorted_rows


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
    rows = empty_rows(env.space, len(plans) * (1 + env.config.episode_steps))
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
