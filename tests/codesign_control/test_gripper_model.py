"""The four-bar's published dimensions, and rate-limited motion."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codesign_control import G1, G2, GripperModel


@pytest.mark.parametrize(
    ("drive_joint", "gap_mm"),
    [(0.0, 88.93), (0.2, 70.81), (0.4, 50.59), (0.6, 29.07), (0.85, 1.65)],
)
def test_stock_pad_gap(drive_joint: float, gap_mm: float) -> None:
    assert GripperModel().width_of(drive_joint) * 1e3 == pytest.approx(gap_mm, abs=0.005)


@given(st.floats(0.0, 0.85))
def test_finger_position_is_the_published_one(q: float) -> None:
    y, z = GripperModel.finger_position(q)
    assert y == pytest.approx(0.035 + 0.035465 * math.cos(q) - 0.042039 * math.sin(q))
    assert z == pytest.approx(0.059098 + 0.035465 * math.sin(q) + 0.042039 * math.cos(q))


def test_fingers_move_12_35_mm_forward_while_closing() -> None:
    gripper = GripperModel()
    assert gripper.finger_z(gripper.min_width) == pytest.approx(0.0, abs=1e-12)
    assert gripper.finger_z(gripper.max_width) * 1e3 == pytest.approx(-12.35, abs=0.005)


@given(st.floats(0.0, 0.85), st.floats(0.0, 0.06))
def test_width_and_drive_joint_invert_each_other(q: float, protrusion: float) -> None:
    gripper = GripperModel(protrusion)
    width = gripper.width_of(q)
    if width < 0:  # fingers of this depth would overlap
        assert gripper.clip(width) == 0.0
        with pytest.raises(ValueError, match="width"):
            gripper.drive_joint(width)
    else:
        assert gripper.drive_joint(width) == pytest.approx(q, abs=1e-9)


def test_deep_fingers_meet_before_the_drives_end() -> None:
    assert GripperModel(0.019 + 0.0077).min_width > 0
    deep = GripperModel(0.019 + 0.015)
    assert deep.min_width == 0.0
    assert deep.drive_joint(0.0) < 0.85
    assert deep.max_width == pytest.approx(GripperModel().max_width - 2 * (0.034 - 0.026))


def test_moves_no_faster_than_asked_and_arrives() -> None:
    gripper = GripperModel(width=0.08)
    widths = [0.08] + [gripper.step(0.03, 0.01, speed=0.1).width for _ in range(60)]
    speeds = np.abs(np.diff(widths)) / 0.01
    assert speeds.max() == pytest.approx(0.1)
    assert widths[-1] == 0.03
    assert not gripper.step(0.03, 0.01).moving


def test_speed_is_limited_to_what_the_gripper_accepts() -> None:
    fast = GripperModel(spec=G2, width=0.08).step(0.01, 0.01, speed=9.0)
    assert fast.velocity == pytest.approx(-0.225)
    slow = GripperModel(spec=G2, width=0.08).step(0.01, 0.01, speed=1e-6)
    assert slow.velocity == pytest.approx(-0.015)
    assert slow.moving
    assert GripperModel(spec=G1, width=0.08).step(0.01, 0.01).velocity == pytest.approx(-0.168)


def test_g1_speed_is_its_drive_joints_at_the_slowest_place() -> None:
    gripper, step = GripperModel(), 1e-6
    joints = np.linspace(0.0, 0.85, 50)
    rates = [abs(gripper.width_of(q + step) - gripper.width_of(q)) / step for q in joints]
    assert 2.0 * min(rates) == pytest.approx(G1.max_speed, abs=5e-4)


def test_targets_out_of_reach_end_at_the_stop() -> None:
    gripper = GripperModel()
    assert gripper.step(-1.0, 10.0).width == gripper.min_width
    assert gripper.step(+1.0, 10.0).width == gripper.max_width


@pytest.mark.parametrize(
    ("target", "dt", "speed"),
    [(math.nan, 0.01, 0.1), (0.02, 0.0, 0.1), (0.02, math.nan, 0.1), (0.02, 0.01, -1.0)],
)
def test_refuses_bad_values_and_stays(target: float, dt: float, speed: float) -> None:
    gripper = GripperModel(width=0.05)
    with pytest.raises(ValueError, match=r"width|dt|speed"):
        gripper.step(target, dt, speed)
    assert gripper.width == 0.05


@pytest.mark.parametrize("protrusion", [0.08, math.nan, math.inf])
def test_refuses_fingers_that_cannot_open(protrusion: float) -> None:
    with pytest.raises(ValueError, match="protrusion"):
        GripperModel(protrusion)
