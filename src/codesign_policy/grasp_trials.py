"""Scripted grasps in the simulator alone: hand and gripper go exactly where they are told.

For judging fingers by the dozen. The graph's trials add the arm, its lag and the messages.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from codesign_design.finger_pair import FingerPair
from codesign_policy.domain import TrialDomain
from codesign_policy.metrics import GraspMetrics, grasp_metrics
from codesign_policy.scripted import GraspPlan, ScriptedGrasp
from codesign_policy.simulated_fingers import simulated_fingers
from codesign_policy.task import POLICY_PERIOD, Observation
from codesign_sim import Block, FingerTargets, Material, Simulator

START_HEIGHT = 0.25  # m, of the grasp frame above the table
LONGEST = 30.0  # s
HELD = 1.0  # s, at the end


@dataclass(frozen=True)
class GraspTrial:
    """One grasp.

    Attributes:
        metrics: as of every trial; stresses are means over the time of contact.
        held_top10, held_median: means over the last second [Pa]; NaN if the block was dropped.
        peak_top10: largest top-10 % stress of the whole grasp [Pa].
    """

    metrics: GraspMetrics
    held_top10: float
    held_median: float
    peak_top10: float


def run_grasps(
    fingers: FingerPair,
    plans: Sequence[GraspPlan],
    domains: Sequence[TrialDomain],
    tetrahedra: int = 2400,
    on_progress: Callable[[float], None] | None = None,
) -> list[GraspTrial]:
    """One grasp per plan and domain, side by side on a table at height 0.

    Args:
        fingers: the same for all.
        plans, domains: as many of one as of the other; domains without NaN.
        tetrahedra: resolution of the block.
        on_progress: called with the simulated time so far [s].

    Raises:
        ValueError: a plan closes further than the fingers allow; lengths differ.
    """
    if len(plans) != len(domains) or not plans:
        raise ValueError(f"{len(plans)} plans for {len(domains)} domains: give one of each")
    simulator = Simulator(
        Block.tofu(tetrahedra), simulated_fingers(fingers), environments=len(plans)
    )
    policies = [
        ScriptedGrasp(p, 0.0, tip_depth=fingers.tip_depth, min_width=fingers.min_width)
        for p in plans
    ]
    state = np.array(
        [[d.x, d.y, START_HEIGHT, p.open_width] for p, d in zip(plans, domains, strict=True)]
    )
    simulator.reset(
        [Material(d.young_modulus, d.poisson_ratio, d.density, d.friction) for d in domains],
        position=np.array([[d.x, d.y] for d in domains]),
        yaw=np.array([d.yaw for d in domains]),
        fingers=_targets(state),
    )
    samples = [_sample(simulator)]
    while not all(policy.done for policy in policies) and len(samples) * POLICY_PERIOD < LONGEST:
        places = simulator.object_pose()[0]
        actions = [
            policy.act(Observation(now[:3], place, float(now[3])))
            for policy, place, now in zip(policies, places, state, strict=True)
        ]
        state = state + [[*action.translation, action.width] for action in actions]
        simulator.advance(POLICY_PERIOD, _targets(state))
        samples.append(_sample(simulator))
        if on_progress is not None:
            on_progress(simulator.time)
    return _judge(samples)


def _targets(state: np.ndarray) -> FingerTargets:
    return FingerTargets.from_above(state[:, :3], state[:, 3])


def _sample(simulator: Simulator) -> np.ndarray:
    """(E, 9): top-10 %, median, left and right force, height of the centre."""
    stress, contact = simulator.stress(), simulator.contact()
    height = simulator.object_pose()[0][:, 2]
    return np.column_stack([stress.top10_mean, stress.median, contact.left, contact.right, height])


def _judge(samples: list[np.ndarray]) -> list[GraspTrial]:
    times = np.arange(len(samples)) * POLICY_PERIOD
    held = times > times[-1] - HELD
    trials = []
    for series in np.stack(samples, axis=1):
        top10, median = series[:, 0], series[:, 1]
        metrics = grasp_metrics(times, top10, median, series[:, 2:5], series[:, 5:8], series[:, 8])
        share = 1.0 if metrics.success else np.nan
        trials.append(
            GraspTrial(
                metrics,
                float(top10[held].mean() * share),
                float(median[held].mean() * share),
                float(top10.max()),
            )
        )
    return trials


def summary(trials: Sequence[GraspTrial]) -> dict[str, float]:
    """Counts, and means over the grasps that succeeded [Pa]; NaN if none did."""
    good = [trial for trial in trials if trial.metrics.success]

    def mean(values: list[float]) -> float:
        return float(np.mean(values)) if values else float("nan")

    return {
        "grasps": len(trials),
        "succeeded": len(good),
        "held_top10_pa": mean([t.held_top10 for t in good]),
        "held_median_pa": mean([t.held_median for t in good]),
        "contact_top10_pa": mean([t.metrics.top10_stress for t in good]),
        "contact_median_pa": mean([t.metrics.median_stress for t in good]),
        "peak_top10_pa": mean([t.peak_top10 for t in good]),
    }
