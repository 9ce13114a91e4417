"""Grasp metrics: the one definition, for simulated episodes and recorded bags alike.

Source: Ikemura et al., "Efficient End-effector Co-Design by Demonstration for Deformable Fragile
Object Manipulation", section IV-A (success, top-10 % stress mean, median stress, "averaged over
the interaction period") and equation 2 (score). What the paper leaves open is stated here as a
constant: what counts as contact, how high and how long is "picked up".
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from codesign_policy.domain import BLOCK_SIZE

CONTACT_FORCE = 0.02
"""A finger touches the object from this force on [N]; 3 % of the block's weight of 0.6 N."""

SUCCESS_LIFT = 0.08
"""The object counts as picked up from this rise on [m]; twice the block's height."""

HOLD_TIME = 1.0
"""It must stay up for this long, to the very end of the episode [s]."""

CLOSED_MARGIN = 0.001
"""Without forces, fingers count as closed on the block from its thickness and this on [m]."""

HELD_DISTANCE = 0.05
"""Without forces, the block counts as held up to this far from the grasp frame [m]."""

LAST_SIGHT = 0.3
"""Without forces, the block must have been seen this shortly before the episode's end [s]."""

STILL_ACCELERATION = 0.5
"""Held forces are read while the vertical acceleration is below this [m/s^2]; 5 % of gravity."""


@dataclass(frozen=True)
class GraspMetrics:
    """Outcome of one grasp; the fields of codesign_interfaces/TrialMetrics.

    NaN also stands for what was not measured: stress, force and score of a real arm's trial.

    Attributes:
        success: the object was lifted by `SUCCESS_LIFT` and still up, for `HOLD_TIME`, at the end.
        top10_stress: mean over the interaction period of the mean von Mises stress of the 10 %
            most stressed tetrahedra [Pa]; NaN if the fingers never touched the object.
        median_stress: the same for the median over the tetrahedra [Pa].
        peak_lift: largest rise of the object's centre above its place on the table [m].
        held_force: mean vertical force of both fingers on the object over the last `HOLD_TIME`
            that it was up and not accelerating [N]; NaN if it never was. Equals the weight.
        interaction_time: for how long a finger touched the object [s].
        score: equation 2, dimensionless, 0 to 1000.
    """

    success: bool
    top10_stress: float
    median_stress: float
    peak_lift: float
    held_force: float
    interaction_time: float
    score: float


def score(success_rate: float, top10_stress: float) -> float:
    """Equation 2: max(0, 1000 success_rate - top10_stress / 200).

    Args:
        success_rate: share of successful episodes, 0 to 1.
        top10_stress: mean top-10 % stress [Pa]; NaN (never touched) scores 0.
    """
    if not 0.0 <= success_rate <= 1.0:
        raise ValueError(f"success_rate is {success_rate}: give a share from 0 to 1")
    if np.isnan(top10_stress):
        return 0.0
    return max(0.0, 1000.0 * success_rate - top10_stress / 200.0)


def in_contact(
    left_force: npt.ArrayLike, right_force: npt.ArrayLike, threshold: float = CONTACT_FORCE
) -> npt.NDArray[np.bool_]:
    """When a finger touches the object.

    Args:
        left_force, right_force: of each finger on the object, (T, 3) [N].
        threshold: smallest force norm that counts [N].

    Returns:
        (T,) True where either force exceeds the threshold.
    """
    left, right = (np.linalg.norm(f, axis=-1) for f in (left_force, right_force))
    return np.asarray((left > threshold) | (right > threshold), dtype=np.bool_)


def lift(object_height: npt.ArrayLike, contact: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """Rise above the resting height: the median height before the first contact.

    Args:
        object_height: of the object's centre, (T,) [m].
        contact: (T,) from `in_contact`. In contact from the start: the first height is rest.

    Returns:
        (T,) [m].
    """
    height = np.asarray(object_height, dtype=np.float64)
    first = int(np.argmax(contact)) if contact.any() else len(height)
    return height - np.median(height[: max(first, 1)])


def grasp_metrics(
    times: npt.ArrayLike,
    top10_stress: npt.ArrayLike,
    median_stress: npt.ArrayLike,
    left_force: npt.ArrayLike,
    right_force: npt.ArrayLike,
    object_height: npt.ArrayLike,
    *,
    success_lift: float = SUCCESS_LIFT,
    hold_time: float = HOLD_TIME,
    contact_force: float = CONTACT_FORCE,
) -> GraspMetrics:
    """Judge one episode from its time series, all sampled at the same times.

    Averages weigh each sample by the time it stands for, so lost samples do not shift them; for
    evenly spaced samples they are plain means.

    Args:
        times: (T,) strictly increasing, T >= 2, any origin [s].
        top10_stress: mean von Mises stress of the 10 % most stressed tetrahedra, (T,) [Pa].
        median_stress: median over the tetrahedra, (T,) [Pa].
        left_force, right_force: of each finger on the object, z up, (T, 3) [N].
        object_height: of the object's centre, (T,) [m].
        success_lift: rise that counts as picked up [m].
        hold_time: how long it must stay up, to the end [s].
        contact_force: smallest finger force that counts as contact [N].

    Raises:
        ValueError: a series has the wrong shape or is not finite, or times do not increase.
    """
    t = _times(times)
    top10 = _series("top10_stress", top10_stress, t.shape)
    median = _series("median_stress", median_stress, t.shape)
    left = _series("left_force", left_force, (len(t), 3))
    right = _series("right_force", right_force, (len(t), 3))
    height = _series("object_height", object_height, t.shape)
    for name, value in (("success_lift", success_lift), ("hold_time", hold_time)):
        if not value > 0.0:
            raise ValueError(f"{name} is {value}: give a value above 0")

    contact = in_contact(left, right, contact_force)
    rise = lift(height, contact)
    weights = np.gradient(t) * contact
    interaction_time = math.fsum(weights)
    mean_top10 = _mean(top10, weights)

    up = contact & (rise >= success_lift)
    success = bool(up[-1] and t[-1] - t[_last_run(up).start] >= hold_time - 1e-9)
    return GraspMetrics(
        success=success,
        top10_stress=mean_top10,
        median_stress=_mean(median, weights),
        peak_lift=float(max(rise.max(), 0.0)),
        held_force=_held_force(t, left[:, 2] + right[:, 2], height, up, hold_time),
        interaction_time=interaction_time,
        score=score(float(success), mean_top10),
    )


def pose_metrics(
    start: int,
    end: int,
    object_position: Mapping[int, npt.ArrayLike],
    tool_position: Mapping[int, npt.ArrayLike],
    width: Mapping[int, float],
    *,
    thickness: float = BLOCK_SIZE[1],
    success_lift: float = SUCCESS_LIFT,
    hold_time: float = HOLD_TIME,
) -> GraspMetrics:
    """Judge an episode without stress and forces, as of a real arm: by pose and gripper alone.

    In place of a contact force counts that the fingers are closed to the block's thickness and the
    block is between them. Series are by stamp [ns]; those of tool and gripper are interpolated at
    the stamps of the object's poses.

    Args:
        start, end: the episode lasts from after `start` to `end` [ns].
        object_position: centre of the object, (3,) each [m].
        tool_position: of the grasp frame, (3,) each [m].
        width: gap of the fingers [m].
        thickness: of the object between the fingers [m].
        success_lift, hold_time: as in `grasp_metrics`.

    Returns:
        Stresses, force and score are NaN: they were not measured.

    Raises:
        ValueError: fewer than 2 poses of the object in the episode, no tool or gripper, or a value
            that is not finite.
    """
    seen, centre = _by_stamp("object_position", object_position, 3)
    inside = (seen > start) & (seen <= end)
    seen, centre = seen[inside], centre[inside]
    if len(seen) < 2:
        raise ValueError(
            f"the object was seen {len(seen)} times while the policy ran "
            f"({(end - start) * 1e-9:.1f} s), at least 2 are needed"
        )
    t = (seen - start) * 1e-9
    tool = _at(t, start, "tool_position", tool_position, 3)
    gap = _at(t, start, "width", width, 1)[:, 0]
    between = np.linalg.norm(centre - tool, axis=1) <= HELD_DISTANCE
    contact = between & (gap <= thickness + CLOSED_MARGIN)
    rise = lift(centre[:, 2], contact)
    up = contact & (rise >= success_lift)
    held = up[-1] and t[-1] - t[_last_run(up).start] >= hold_time - 1e-9
    nan = float("nan")
    return GraspMetrics(
        success=bool(held and (end - seen[-1]) * 1e-9 <= LAST_SIGHT),
        top10_stress=nan,
        median_stress=nan,
        peak_lift=float(max(rise.max(), 0.0)),
        held_force=nan,
        interaction_time=math.fsum(np.gradient(t) * contact),
        score=nan,
    )


def _by_stamp(
    name: str, values: Mapping[int, npt.ArrayLike], size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (T,) [ns], ascending, and values (T, size)."""
    stamps = sorted(values)
    rows = np.array([values[stamp] for stamp in stamps], dtype=np.float64).reshape(-1, size)
    _require_finite(name, rows)
    return np.array(stamps, dtype=np.int64), rows


def _at(
    t: np.ndarray, start: int, name: str, values: Mapping[int, npt.ArrayLike], size: int
) -> np.ndarray:
    """Values at times since `start`, (T, size)."""
    stamps, rows = _by_stamp(name, values, size)
    if not len(stamps):
        raise ValueError(f"{name} has no samples")
    times = (stamps - start) * 1e-9
    return np.column_stack([np.interp(t, times, rows[:, k]) for k in range(size)])


def _held_force(
    t: np.ndarray, force: np.ndarray, height: np.ndarray, up: np.ndarray, hold_time: float
) -> float:
    """Mean vertical force over the last `hold_time` that the object was up and nearly still."""
    run = _last_run(up)
    if run.stop - run.start < 2:
        return float("nan")
    # Differences over a few samples: sampled heights carry noise that a double derivative blows up.
    acceleration = np.gradient(_smooth(np.gradient(height, t)), t)
    still = np.abs(acceleration) < STILL_ACCELERATION
    recent = t >= t[run.stop - 1] - hold_time
    within = np.zeros_like(up)
    within[run] = True
    return _mean(force, np.gradient(t) * (within & recent & still))


def _smooth(values: np.ndarray) -> np.ndarray:
    """Mean over three neighbours, with the ends repeated."""
    padded = np.pad(values, 1, mode="edge")
    return (padded[:-2] + padded[1:-1] + padded[2:]) / 3.0


def _last_run(mask: np.ndarray) -> slice:
    """The last unbroken stretch of True; slice(0, 0) if there is none."""
    if not mask.any():
        return slice(0, 0)
    stop = len(mask) - int(np.argmax(mask[::-1]))
    gaps = np.flatnonzero(~mask[:stop])
    return slice(int(gaps[-1]) + 1 if len(gaps) else 0, stop)


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    # fsum rounds once: a dot product's last bit depends on how the array lies in memory, and live
    # and recorded series must give equal metrics.
    total = math.fsum(weights)
    return math.fsum(values * weights) / total if total > 0.0 else float("nan")


def _times(times: npt.ArrayLike) -> np.ndarray:
    t = np.asarray(times, dtype=np.float64)
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(f"times has shape {t.shape}: give at least 2 samples in one dimension")
    _require_finite("times", t)
    backwards = np.flatnonzero(np.diff(t) <= 0.0)
    if len(backwards):
        i = int(backwards[0])
        raise ValueError(
            f"times[{i + 1}] is {t[i + 1]} s after {t[i]} s: sort the samples and drop duplicates"
        )
    return t


def _series(name: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}: times asks for {shape}")
    _require_finite(name, array)
    return array


def _require_finite(name: str, array: np.ndarray) -> None:
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        where = ", ".join(map(str, index))
        raise ValueError(f"{name}[{where}] is {array[index]}: give finite numbers")
