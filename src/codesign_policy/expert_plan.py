"""The gap to which an expert closes given fingers: the best of a sweep in the simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from codesign_design.finger_pair import FingerPair
from codesign_policy.codesign_env import COMPONENTS
from codesign_policy.control_env import ControlConfig
from codesign_policy.domain import draw_domain
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
METRICS = ("success", "top10_stress")


class DemonstrationError(RuntimeError):
    """Fingers that the expert cannot use, or that do not pick the block up."""


def best_plan(fingers: FingerPair, tetrahedra: int, seed: int) -> tuple[GraspPlan, int]:
    """The expert's plan with the best of `GAPS` gaps, and how many of these succeed.

    A gap counts if those a step tighter and a step wider succeed as well, and by the mean of the
    three's top-10 % stress: who learns from it will not hit it exactly.

    Args:
        fingers: in use.
        tetrahedra: resolution of the block.
        seed: of the block.

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
    config = ControlConfig(tetrahedra=tetrahedra, domain=draw_domain(seed))
    env = GivenFingers(GAPS, fingers, config)
    size = len(fingers.parameters)
    spaces = Spaces(8 + size, size, 7)
    rows = ReplayBuffer(spaces, COMPONENTS, GAPS)  # nobody reads them
    expert = ReactiveLanes([fingers] * GAPS, plans)
    metrics = play_round(Episodes(env, COMPONENTS, METRICS), seed, expert.act, rows).metrics
    env.close()
    success = metrics["success"].astype(bool)
    three = np.stack([metrics["top10_stress"][k : GAPS - 2 + k] for k in range(3)])
    safe = success[1:-1] & success[:-2] & success[2:]
    if not safe.any():
        raise DemonstrationError(
            f"fingers {fingers.name!r}: no gap from {1e3 * widths[0]:.2f} to "
            f"{1e3 * widths[-1]:.2f} mm lifts the block, with a margin of {1e3 * step:g} mm"
        )
    stress = np.where(safe, three.mean(axis=0), np.inf)
    return plans[1 + int(stress.argmin())], int(success.sum())
