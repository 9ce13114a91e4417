"""Grasp metrics against hand-made episodes with known answers."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codesign_policy import metrics
from codesign_policy.metrics import GraspMetrics, grasp_metrics, pose_metrics, score

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


# --- without stress and forces, as of a real arm

START, PERIOD = 1_700_000_000_000_000_000, 50_000_000  # ns


def real_grasp(**changes):
    """11 s: open to 4 s, closed on a 30 mm block from then on, up by 0.1 m from 6 s."""
    stamps = [START + k * PERIOD for k in range(1, 221)]
    seconds = {stamp: (stamp - START) * 1e-9 for stamp in stamps}
    grasp = {
        "start": START,
        "end": stamps[-1],
        "object_position": {
            s: [0.45, 0.0, 0.02 + (0.1 if t >= 6.0 else 0.0)] for s, t in seconds.items()
        },
        "tool_position": {
            s: [0.45, 0.0, 0.01 + (0.1 if t >= 6.0 else 0.0)] for s, t in seconds.items()
        },
        "width": {s: 0.046 if t < 4.0 else 0.0273 for s, t in seconds.items()},
    }
    for name, change in changes.items():
        grasp[name] = change({s: grasp[name][s] for s in stamps}) if callable(change) else change
    return grasp


def test_pose_and_gripper_tell_a_grasp():
    metrics = pose_metrics(**real_grasp())
    assert metrics.success
    assert metrics.peak_lift == pytest.approx(0.1)
    assert metrics.interaction_time == pytest.approx(7.0, abs=0.06)
    unknown = ("top10_stress", "median_stress", "held_force", "score")
    assert all(np.isnan(getattr(metrics, name)) for name in unknown)


def later(series, seconds, value):
    """The series with another value from a time on."""
    return {s: value if (s - START) * 1e-9 >= seconds else v for s, v in series.items()}


@pytest.mark.parametrize(
    "change",
    [
        {"object_position": lambda p: later(p, 10.5, [0.45, 0.0, 0.02])},  # dropped near the end
        {"object_position": lambda p: later(p, 0.0, [0.45, 0.0, 0.02])},  # left behind
        {"width": lambda w: later(w, 10.9, 0.04)},  # let go, and a pose that is late
        {"width": lambda w: later(w, 0.0, 0.046)},  # never closed: the pose is wrong
        {"tool_position": lambda p: later(p, 0.0, [0.45, 0.2, 0.11])},  # not between the fingers
        {"object_position": lambda p: {s: v for s, v in p.items() if s < START + 10.6e9}},  # unseen
    ],
)
def test_pose_and_gripper_tell_a_failure(change):
    assert not pose_metrics(**real_grasp(**change)).success


def test_it_must_be_up_for_the_hold_time():
    lifted = [0.45, 0.0, 0.12]
    table = {s: [0.45, 0.0, 0.02] for s in real_grasp()["object_position"]}

    def up_from(seconds):
        places = later(table, seconds, lifted)
        tools = {s: [x, y, z - 0.01] for s, (x, y, z) in places.items()}
        return pose_metrics(**real_grasp(object_position=places, tool_position=tools)).success

    assert up_from(10.0)
    assert not up_from(10.1)


def test_tool_and_gripper_are_interpolated():
    half = {s + PERIOD // 2: v for s, v in real_grasp()["width"].items()}
    assert pose_metrics(**real_grasp(width=half)).success


def test_too_little_is_named():
    with pytest.raises(ValueError, match="the object was seen 1 times"):
        pose_metrics(**real_grasp(object_position={START + PERIOD: [0.45, 0.0, 0.02]}))
    with pytest.raises(ValueError, match="width has no samples"):
        pose_metrics(**real_grasp(width={}))
    with pytest.raises(ValueError, match=r"tool_position\[3, 2\] is nan"):
        pose_metrics(
            **real_grasp(
                tool_position=lambda p: {
                    s: [0.45, 0.0, np.nan if k == 3 else 0.1] for k, s in enumerate(p)
                }
            )
        )
