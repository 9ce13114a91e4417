"""What each gripper did over its trials, and against the gripper that it is measured by."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from codesign_policy.metrics import GraspMetrics, score

BASELINES = ("original", "stock")
"""Labels of grippers that others are measured by, the first that there is."""


@dataclass(frozen=True)
class Labelled:
    """Metrics of one trial and what they are of."""

    gripper: str
    seed: int
    metrics: GraspMetrics


@dataclass(frozen=True)
class GripperResult:
    """A gripper over its trials, as in the paper's table I.

    Attributes:
        gripper: label.
        trials: how many.
        success_rate: share, 0 to 1.
        top10, median: mean and standard deviation over the trials [Pa]; NaN where no finger ever
            touched.
        score: equation 2.
        baseline: label of the gripper it is compared with; empty: none, or it is the one.
        top10_ratio, median_ratio: means over those of the baseline, on the seeds on which both
            touched the object; NaN without a baseline or such a seed.
    """

    gripper: str
    trials: int
    success_rate: float
    top10: tuple[float, float]
    median: tuple[float, float]
    score: float
    baseline: str = ""
    top10_ratio: float = math.nan
    median_ratio: float = math.nan


def compare(trials: Sequence[Labelled]) -> list[GripperResult]:
    """One result per gripper, by label; the baseline comes last."""
    ordered = sorted(trials, key=lambda t: t.gripper)
    groups = {name: list(group) for name, group in groupby(ordered, key=lambda t: t.gripper)}
    baseline = next((name for name in BASELINES if name in groups and len(groups) > 1), "")
    names = [name for name in groups if name != baseline] + [baseline] * bool(baseline)
    return [_result(groups[name], groups.get(baseline, [])) for name in names]


def _result(own: Sequence[Labelled], baseline: Sequence[Labelled]) -> GripperResult:
    metrics = [trial.metrics for trial in own]
    rate = float(np.mean([m.success for m in metrics]))
    top10 = _spread([m.top10_stress for m in metrics])
    median = _spread([m.median_stress for m in metrics])
    gripper = own[0].gripper
    result = GripperResult(gripper, len(own), rate, top10, median, score(rate, top10[0]))
    if not baseline or baseline[0].gripper == gripper:
        return result
    return replace(
        result,
        baseline=baseline[0].gripper,
        top10_ratio=_ratio(own, baseline, "top10_stress"),
        median_ratio=_ratio(own, baseline, "median_stress"),
    )


def _ratio(own: Sequence[Labelled], baseline: Sequence[Labelled], name: str) -> float:
    """Of the means over the seeds on which both touched the object."""
    ours, theirs = ({t.seed: getattr(t.metrics, name) for t in side} for side in (own, baseline))
    common = [s for s in ours.keys() & theirs.keys() if math.isfinite(ours[s] + theirs[s])]
    if not common:
        return math.nan
    return float(np.mean([ours[s] for s in common]) / np.mean([theirs[s] for s in common]))


def _spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation of the values that are defined."""
    defined = [v for v in values if math.isfinite(v)]
    if not defined:
        return math.nan, math.nan
    return float(np.mean(defined)), float(np.std(defined))
