"""Grasp metrics against hand-made episodes with known answers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codesign_policy import metrics
from codesign_policy.metrics import GraspMetrics, grasp_metrics, score

WEIGHT = 0.6
RATE = 20.0


def episode(lift=0.1, drop=False, rate=RATE):
    """Touch at 1 s, lift from 2 s to 3 s, hold until 5 s; stress 3000/600 Pa while in contact."""
    t = np.arange(0.0, 5.0 + 1e-9, 1.0 / rate)
    contact = t >= 1.0
    height = 0.02 + lift * np.clip(t - 2.0, 0.0, 1.0)
    if drop:
        contact &= t < 4.5
        height[t >= 4.5] = 0.02
    force = np.zeros((len(t), 3))
    force[contact] = [0.0, 0.5, WEIGHT / 2]
    return {
        "times": t,
        "top10_stress": np.where(contact, 3000.0, 200.0),
        "median_stress": np.where(contact, 600.0, 100.0),
        "left_force": force,
        "right_force": force * [1.0, -1.0, 1.0],
        "object_height": height,
    }


def test_a_good_grasp():
    result = grasp_metrics(**episode())
    assert result == GraspMetrics(
        success=True,
        top10_stress=pytest.approx(3000.0),
        median_stress=pytest.approx(600.0),
        peak_lift=pytest.approx(0.1),
        held_force=pytest.approx(WEIGHT),
        interaction_time=pytest.approx(4.0, abs=1.0 / RATE),
        score=pytest.approx(1000.0 - 3000.0 / 200.0),
    )


def test_stress_without_contact_does_not_count():
    data = episode()
    touching = metrics.in_contact(data["left_force"], data["right_force"])
    data["top10_stress"][~touching] = 1e6
    assert grasp_metrics(**data).top10_stress == pytest.approx(3000.0)


def test_one_finger_is_contact():
    data = episode()
    data["right_force"] = np.zeros_like(data["left_force"])
    assert grasp_metrics(**data).interaction_time == pytest.approx(4.0, abs=1.0 / RATE)


def test_lost_samples_do_not_shift_the_mean():
    data = episode(rate=100.0)
    data["top10_stress"] = 1000.0 * data["times"]
    whole = grasp_metrics(**data).top10_stress
    kept = np.ones(len(data["times"]), dtype=bool)
    kept[np.random.default_rng(0).integers(110, 300, 120)] = False
    some = grasp_metrics(**{k: v[kept] for k, v in data.items()}).top10_stress
    assert some == pytest.approx(whole, rel=2e-3)
    assert abs(np.mean(data["top10_stress"][kept][100:]) / whole - 1.0) > 2e-2


def test_too_low_is_no_success():
    result = grasp_metrics(**episode(lift=0.079))
    assert not result.success
    assert result.score == 0.0
    assert grasp_metrics(**episode(lift=0.079), success_lift=0.07).success


def test_too_short_is_no_success():
    data = episode()
    short = data["times"] <= 3.7
    assert not grasp_metrics(**{k: v[short] for k, v in data.items()}).success


def test_dropped_at_the_end_is_no_success_yet_it_was_held():
    result = grasp_metrics(**episode(drop=True))
    assert not result.success
    assert result.peak_lift == pytest.approx(0.1)
    assert result.held_force == pytest.approx(WEIGHT)


def test_up_without_a_finger_is_no_success():
    data = episode()
    late = data["times"] > 3.5
    data["left_force"][late] = data["right_force"][late] = 0.0
    assert not grasp_metrics(**data).success


def test_held_force_ignores_acceleration():
    data = episode(rate=100.0)
    shaking = (data["times"] > 4.2) & (data["times"] < 4.6)
    phase = 2.0 * math.pi * (data["times"] - 4.2) / 0.4
    data["object_height"] += np.where(shaking, 0.005 * np.sin(phase), 0.0)
    strong = np.abs(np.sin(phase)) > 0.5
    data["left_force"][shaking & strong, 2] *= 3.0
    assert grasp_metrics(**data).held_force == pytest.approx(WEIGHT, rel=1e-6)


def test_never_touched():
    data = episode(lift=0.0)
    data["left_force"] = data["right_force"] = np.zeros_like(data["left_force"])
    result = grasp_metrics(**data)
    assert not result.success
    assert math.isnan(result.top10_stress)
    assert math.isnan(result.median_stress)
    assert math.isnan(result.held_force)
    assert (result.interaction_time, result.score, result.peak_lift) == (0.0, 0.0, 0.0)


def test_resting_height_is_before_contact():
    data = episode()
    data["object_height"][0] += 0.05  # dropped onto the table at the start
    assert grasp_metrics(**data).peak_lift == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("rate", "stress", "expected"),
    [(1.0, 2542.21, 987.289), (1.0, 8634.69, 956.827), (0.0, 100.0, 0.0), (0.5, 2e5, 0.0)],
)
def test_score_is_equation_2(rate, stress, expected):
    assert score(rate, stress) == pytest.approx(expected, abs=1e-3)


@given(shift=st.floats(-1e6, 1e6))
def test_shifting_time_changes_nothing(shift):
    data = episode()
    before = grasp_metrics(**data)
    data["times"] = data["times"] + shift
    after = grasp_metrics(**data)
    assert after.success == before.success
    for name in ("top10_stress", "median_stress", "peak_lift", "held_force", "interaction_time"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), rel=1e-6)


@given(factor=st.floats(0.01, 100.0), base=st.floats(-1.0, 1.0))
def test_scaling_stress_and_moving_the_table(factor, base):
    data = episode()
    before = grasp_metrics(**data)
    data["top10_stress"] = data["top10_stress"] * factor
    data["object_height"] = data["object_height"] + base
    after = grasp_metrics(**data)
    assert after.top10_stress == pytest.approx(factor * before.top10_stress)
    assert after.peak_lift == pytest.approx(before.peak_lift)
    assert after.success


@pytest.mark.parametrize(
    "name",
    ["top10_stress", "median_stress", "left_force", "right_force", "object_height", "times"],
)
def test_not_finite_is_named(name):
    data = episode()
    data[name] = data[name].copy()
    data[name][3] = np.nan
    with pytest.raises(ValueError, match=rf"{name}\[3.*nan"):
        grasp_metrics(**data)


@pytest.mark.parametrize("name", ["top10_stress", "left_force", "object_height"])
def test_mismatched_length_is_named(name):
    data = episode()
    data[name] = data[name][:-1]
    with pytest.raises(ValueError, match=f"{name} has shape"):
        grasp_metrics(**data)


def test_unsorted_times_are_refused():
    data = episode()
    data["times"][5] = data["times"][4]
    with pytest.raises(ValueError, match=r"times\[5\]"):
        grasp_metrics(**data)


def test_one_sample_is_refused():
    with pytest.raises(ValueError, match="at least 2"):
        grasp_metrics(**{k: v[:1] for k, v in episode().items()})


@pytest.mark.parametrize("name", ["success_lift", "hold_time"])
def test_limits_must_be_positive(name):
    with pytest.raises(ValueError, match=name):
        grasp_metrics(**episode(), **{name: 0.0})


def test_success_rate_is_a_share():
    with pytest.raises(ValueError, match="success_rate"):
        score(1.2, 0.0)
