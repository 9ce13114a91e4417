"""Making demonstrations: each expert's inverse design, and the best grasp with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codesign_design.design_space import design_space
from codesign_design.experts import SCOOP_TIP, expert_surface
from codesign_design.finger_pair import FingerPair
from codesign_design.inverse import FitOptions, fit
from codesign_policy.codesign_env import COMPONENTS, CodesignEnv, built_design
from codesign_policy.control_env import ControlConfig
from codesign_policy.demonstrations import Demonstration, Demonstrations, empty_rows
from codesign_policy.domain import draw_domain
from codesign_policy.expert_plan import DemonstrationError, best_plan
from codesign_policy.finger_plan import plan_for
from codesign_policy.proposals import DESIGN_BOUND
from codesign_policy.reactive import ReactiveLanes
from codesign_policy.replay import ReplayBuffer, Transitions
from codesign_policy.rounds import Episodes, Played, play_round
from codesign_policy.scripted import GraspPlan

EXPERTS = ("flat_pad", "cupped_pad", "scoop")
# Of an expert's outline, fits mind these places most, (2, 3) corners [m]: the scoop's lip.
REGIONS = {"scoop": np.array([[-0.035, -0.001, SCOOP_TIP - 0.004], [0.035, 0.012, SCOOP_TIP]])}
RESTARTS = 24  # of a fit
MOST_DRAWN = 10  # designs for each that is wanted
METRICS = ("success", "top10_stress", "median_stress")

Progress = Callable[[str, float], None]
"""Called with what is being done and the share of all work that is done, 0 to 1."""


def demonstrate(
    space: str,
    experts: Sequence[str] = EXPERTS,
    tetrahedra: int = 2400,
    seed: int = 0,
    progress: Progress = lambda what, share: None,
) -> Demonstrations:
    """Fits every expert's finger in the space, finds its best gap and records one grasp of each.

    The grasp is the reactive one, with the gap that suits the fitted finger best (`best_plan`).

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
    fits, plans, holding = [], [], []
    for k, name in enumerate(experts):
        fits.append(_fitted(space, name, seed, part(f"fitting {name}", 2 * k)))
        part(f"grasping with {name}", 2 * k + 1)(0.0)
        plan, gaps = _best_plan(space, name, fits[-1][0], tetrahedra, seed)
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


def practise(
    shown: Demonstrations, episodes: int, config: ControlConfig, spread: float, seed: int
) -> Transitions:
    """More of the expert's grasps, with fingers scattered around the gentlest demonstrated ones.

    What has been demonstrated once, on one block, says little about what to do beside it. Every
    finger closes as far beyond its own planned gap as the demonstrated one did.

    Args:
        shown: demonstrations.
        episodes: that are played, side by side.
        config: block, friction and error of the pose of each are drawn as this says.
        spread: standard deviation of the designs, as of a `DesignSearch`.
        seed: of designs and blocks.

    Returns:
        Rows of both stages of the episodes that succeed, perhaps none.

    Raises:
        DemonstrationError: hardly any design around the demonstrated one can be used.
    """
    designs = _around(shown, episodes, spread, seed)
    env = CodesignEnv(shown.space, episodes, config=config)
    env.reset(seed=seed, options={"designs": designs})
    given = built_design(shown.space, shown.gentlest.parameters).fingers
    assert given is not None
    plan = replace(plan_for(given), width=shown.gentlest.width)
    plans = [_adapted(plan, given, fingers) for fingers in env.fingers]
    rows = empty_rows(shown.space, episodes * (1 + config.episode_steps))
    success = _play(env, designs, plans, seed, rows).metrics["success"] == 1.0
    env.close()
    kept = np.repeat(success, 1 + config.episode_steps)
    return _by_episode(rows, episodes).rows.pick(kept)


def _around(shown: Demonstrations, count: int, spread: float, seed: int) -> NDArray[np.float32]:
    """Designs (count, D) around the gentlest demonstrated one that can be printed and used."""
    random = np.random.default_rng([seed, 4])
    centre = np.array(shown.gentlest.parameters)
    found: list[NDArray[np.float32]] = []
    for _ in range(MOST_DRAWN * count):
        drawn = centre + spread * random.normal(size=len(centre))
        design = np.clip(drawn, -DESIGN_BOUND, DESIGN_BOUND).astype(np.float32)
        if built_design(shown.space, tuple(design.astype(np.float64).tolist())).fingers:
            found.append(design)
        if len(found) == count:
            return np.array(found)
    raise DemonstrationError(
        f"{len(found)} of {MOST_DRAWN * count} designs around the demonstrated one can be used, "
        f"{count} are wanted: practise less, or demonstrate a finger with thicker walls"
    )


def _adapted(plan: GraspPlan, given: FingerPair, fingers: FingerPair) -> GraspPlan:
    """The plan that does with these fingers what `plan` does with the given ones."""
    try:
        width = plan.width + plan_for(fingers).width - plan_for(given).width
    except ValueError:  # fingers that can hardly hold anything: their episode won't succeed
        return plan
    return replace(plan, width=max(width, fingers.min_width))


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
    space: str, expert: str, design: NDArray[np.float32], tetrahedra: int, seed: int
) -> tuple[GraspPlan, int]:
    """The plan with the best gap, and how many of the gaps succeed."""
    built = built_design(space, tuple(design.astype(np.float64).tolist()))
    if built.fingers is None:
        raise DemonstrationError(f"{expert} in {space}: {'; '.join(built.problems)}")
    try:
        return best_plan(built.fingers, tetrahedra, seed)
    except DemonstrationError as error:
        raise DemonstrationError(f"{expert} in {space}: {error}; fit it in another space") from None


def _play(
    env: CodesignEnv,
    designs: NDArray[np.float32],
    plans: list[GraspPlan],
    seed: int,
    rows: ReplayBuffer,
) -> Played:
    """One grasp in every lane."""
    env.reset(seed=seed, options={"designs": designs})  # so that the fingers are known
    script = ReactiveLanes(env.fingers, plans)
    episodes = Episodes(env, COMPONENTS, METRICS, env.design_observation)
    return play_round(episodes, seed, script.act, rows, designs)
