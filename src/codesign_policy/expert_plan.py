"""The gap to which an expert closes given fingers: the best of a sweep in the simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair
from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.control_env import ControlConfig
from codesign_policy.domain import FRICTION, draw_domain
from codesign_policy.finger_plan import LEAST_LIP, plan_for
from codesign_policy.reactive import ReactiveLanes
from codesign_policy.replay import ReplayBuffer, Spaces
from codesign_policy.rounds import Episodes, play_round
from codesign_policy.run import GivenFingers
from codesign_policy.scripted import GraspPlan
from codesign_policy.simulated_fingers import lip

GAPS = 16  # that are tried
PAD_STEP, LIP_STEP = 2.5e-4, 1e-3  # m, between them: lips hold in a much wider range than pads
TIGHTER = {PAD_STEP: 8, LIP_STEP: 2}  # steps from the planned gap to the first one
FRICTIONS = (0.4, FRICTION, 0.6)  # of the blocks
METRICS = ("success", "top10_stress", "median_stress")


class DemonstrationError(RuntimeError):
    """Fingers that the expert cannot use, or that do not pick the block up."""


def best_plan(fingers: FingerPair, tetrahedra: int, seed: int) -> tuple[GraspPlan, int]:
    """The expert's plan with the best of `GAPS` gaps, and how many of these always succeed.

    Every gap is tried on three blocks of different friction: with lips a little more of it can
    make the block jam half-way. A gap counts if it always succeeds, and those a step tighter and a
    step wider do at the nominal friction; the best has the least top-10 % and median stress over
    all three gaps and blocks: who learns from it will not hit it exactly.

    Args:
        fingers: in use.
        tetrahedra: resolution of the block.
        seed: of the first block.

    Raises:
        DemonstrationError: no gap succeeds with its neighbours, or fingers that cannot close.
    """
    try:
        plan = plan_for(fingers)
    except ValueError as error:
        raise DemonstrationError(str(error)) from error
    step = LIP_STEP if lip(fingers) > LEAST_LIP else PAD_STEP
    offsets = step * (np.arange(GAPS) - TIGHTER[step])
    widths = np.maximum(plan.width + offsets, fingers.min_width)
    plans = [replace(plan, width=round(float(width), 6)) for width in widths]
    played = [_played(fingers, plans, tetrahedra, seed + k, mu) for k, mu in enumerate(FRICTIONS)]
    success = np.all([each["success"] for each in played], axis=0)
    nominal = played[FRICTIONS.index(FRICTION)]["success"].astype(bool)
    stress = np.mean([each["top10_stress"] + each["median_stress"] for each in played], axis=0)
    safe = success[1:-1] & nominal[:-2] & nominal[2:]
    if not safe.any():
        raise DemonstrationError(
            f"fingers {fingers.name!r}: no gap from {1e3 * widths[0]:.2f} to "
            f"{1e3 * widths[-1]:.2f} mm lifts the block, with a margin of {1e3 * step:g} mm"
        )
    three = (stress[1:-1] + stress[:-2] + stress[2:]) / 3.0
    best = 1 + int(np.where(safe, three, np.inf).argmin())
    return plans[best], int(success.sum())


def _played(
    fingers: FingerPair, plans: list[GraspPlan], tetrahedra: int, seed: int, friction: float
) -> dict[str, NDArray[np.float64]]:
    """Metrics of one grasp with every plan, on equal blocks."""
    domain = replace(draw_domain(seed), friction=friction)
    env = GivenFingers(len(plans), fingers, ControlConfig(tetrahedra=tetrahedra, domain=domain))
    size = len(fingers.parameters)
    rows = ReplayBuffer(Spaces(8 + size, size, 7), COMPONENTS, len(plans))  # nobody reads them
    expert = ReactiveLanes([fingers] * len(plans), plans)
    episodes = Episodes(env, COMPONENTS, METRICS)
    try:
        return play_round(episodes, seed, expert.act, rows).metrics
    finally:
        env.close()
