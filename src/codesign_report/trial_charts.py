"""Which curves of a trial are drawn: alone, or several grippers on the same seed together."""

from collections.abc import Sequence

import numpy as np

from codesign_policy.metrics import SUCCESS_LIFT, in_contact, lift
from codesign_report.charts import Chart, Series
from codesign_report.recording import Floats, TrialRecording

STRESS, FORCE, LIFT, GAP, SEEN = (
    "Von Mises stress",
    "Finger force on the object",
    "Lift",
    "Gripper gap",
    "Camera’s estimate, off the true position",
)
PICKED_UP = ("picked up", 1e3 * SUCCESS_LIFT)  # mm


def own_charts(trial: TrialRecording) -> list[Chart]:
    """Stress, force, lift and gap of one trial, with the interaction period shaded."""
    stress = trial.stress
    t, contact = stress.times, _contact(trial)
    touching = t[contact]
    band = (float(touching[0]), float(touching[-1])) if len(touching) else None
    left, right = _finger_forces(trial)
    upward = stress.left_force[:, 2] + stress.right_force[:, 2]
    charts = [
        Chart(
            STRESS,
            "Pa",
            [Series("top 10 %", t, stress.top10), Series("median", t, stress.median)],
            band=band,
        ),
        Chart(
            FORCE,
            "N",
            [
                Series("left", t, left),
                Series("right", t, right),
                Series("both, upward", t, upward),
            ],
            level=("weight", trial.weight),
            band=band,
            decimals=2,
        ),
        Chart(LIFT, "mm", [_lift("object's centre", trial)], PICKED_UP, band, decimals=1),
    ]
    if len(trial.gripper_times):
        gap = _gap("between the fingers", trial)
        charts.append(Chart(GAP, "mm", [gap], band=band, decimals=1))
    if trial.estimates is not None:
        curves = [_seen("distance", trial), _seen("height", trial, axis=2)]
        charts.append(Chart(SEEN, "mm", curves, band=band, decimals=2))
    return charts


def shared_charts(trials: Sequence[TrialRecording]) -> list[Chart]:
    """The same of several grippers, each in a colour of its own."""
    stress, forces, lifts, gaps = [], [], [], []
    for k, trial in enumerate(trials):
        name, t = trial.gripper, trial.stress.times
        stress += [
            Series(f"{name}, top 10 %", t, trial.stress.top10, k, 0),
            Series(f"{name}, median", t, trial.stress.median, k, 1),
        ]
        forces.append(Series(name, t, np.mean(_finger_forces(trial), axis=0), k, 0))
        lifts.append(_lift(name, trial, k))
        if len(trial.gripper_times):
            gaps.append(_gap(name, trial, k))
    charts = [
        Chart(STRESS, "Pa", stress),
        Chart("Force of each finger, mean", "N", forces, decimals=2),
        Chart(LIFT, "mm", lifts, PICKED_UP, decimals=1),
    ]
    if gaps:
        charts.append(Chart(GAP, "mm", gaps, decimals=1))
    seen = [_seen(t.gripper, t, color=k) for k, t in enumerate(trials) if t.estimates is not None]
    return [*charts, Chart(SEEN, "mm", seen, decimals=2)] if seen else charts


def _contact(trial: TrialRecording) -> np.ndarray:
    return in_contact(trial.stress.left_force, trial.stress.right_force)


def _finger_forces(trial: TrialRecording) -> tuple[Floats, Floats]:
    left, right = trial.stress.left_force, trial.stress.right_force
    return np.linalg.norm(left, axis=1), np.linalg.norm(right, axis=1)


def _lift(name: str, trial: TrialRecording, color: int = 0) -> Series:
    rise = lift(trial.object_height, _contact(trial))
    return Series(name, trial.stress.times, 1e3 * rise, color, 0)


def _gap(name: str, trial: TrialRecording, color: int = 0) -> Series:
    return Series(name, trial.gripper_times, 1e3 * trial.gripper_width, color, 0)


def _seen(
    name: str, trial: TrialRecording, *, axis: int | None = None, color: int | None = None
) -> Series:
    """How far the camera's estimate is off: along an axis, or the distance."""
    assert trial.estimates is not None
    error = trial.estimates.distances if axis is None else trial.estimates.errors[:, axis]
    return Series(name, trial.estimates.times, 1e3 * error, color, None if color is None else 0)
