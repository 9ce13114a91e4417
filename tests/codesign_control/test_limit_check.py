"""The check finds what it must: known derivatives, known distances, and every kind of violation."""

import numpy as np
import pytest

from codesign_control import Hand, ServoConfig, Xarm7
from codesign_control.limit_check import check_log, link_placements, segment_distance

ARM = Xarm7()
FREE = ServoConfig(box_lower=(-2, -2, -2), box_upper=(2, 2, 2), table_height=-2.0)


def standing(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    return 0.01 * np.arange(count), np.repeat(ARM.home[None], count, axis=0)


def test_an_arm_that_stands_violates_nothing() -> None:
    report = check_log(*standing(), widths=np.full(40, 0.06))
    assert report.violations == 0
    assert report.set_points == 40
    tcp = ARM.tcp_placement(ARM.home).translation
    fingers = tcp[2] + Hand().gripper.finger_z(0.06) * -1.0 - 0.0055  # pointing down
    assert report.findings["finger height"].worst == pytest.approx(fingers, abs=1e-6)


@pytest.mark.parametrize("uneven", [False, True])
def test_derivatives_of_a_cubic_are_exact(uneven: bool) -> None:
    times, _ = standing()
    if uneven:
        times = times + 0.003 * np.sin(np.arange(40))
    q = np.repeat(ARM.home[None], 40, axis=0)
    q[:, 6] += 20.0 * times**3 / 6.0
    found = check_log(times, q, FREE).findings
    assert found["joint jerk"].worst == pytest.approx(20.0, rel=1e-6)
    assert found["joint acceleration"].worst <= 20.0 * times[-1]
    assert found["joint velocity"].worst <= 10.0 * times[-1] ** 2


def test_links_are_where_pinocchio_has_them() -> None:
    postures = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, size=(50, 7))
    rotation, origin = link_placements(postures)["link7"]
    for q, r, p in zip(postures, rotation, origin, strict=True):
        flange = ARM.fk_flange(q)
        np.testing.assert_allclose(p, flange.position, atol=1e-12)
        np.testing.assert_allclose(r, flange.rotation, atol=1e-12)


SEGMENTS = {  # ends of two segments, their distance
    "crossing": ([[-1, 0, 0], [1, 0, 0]], [[0, -1, 0.5], [0, 1, 0.5]], 0.5),
    "parallel": ([[0, 0, 0], [1, 0, 0]], [[0.5, 0.3, 0], [2, 0.3, 0]], 0.3),
    "in line": ([[0, 0, 0], [1, 0, 0]], [[3, 0, 0], [4, 0, 0]], 2.0),
    "end to middle": ([[0, 1, 0], [0, 3, 0]], [[-1, 0, 0], [1, 0, 0]], 1.0),
    "points": ([[0, 0, 0], [0, 0, 0]], [[3, 4, 0], [3, 4, 0]], 5.0),
    "meeting": ([[-1, 0, 0], [1, 0, 0]], [[0, -1, 0], [0, 1, 0]], 0.0),
}


@pytest.mark.parametrize("case", SEGMENTS)
def test_segment_distances_of_known_arrangements(case: str) -> None:
    first, second, expected = SEGMENTS[case]
    result = segment_distance(np.array(first, float), np.array(second, float))
    assert float(result) == pytest.approx(expected, abs=1e-12)


def moved(joint: int, step: float) -> np.ndarray:
    _, q = standing()
    q[20:, joint] += step
    return q


def test_every_kind_of_violation_is_found_and_counted() -> None:
    times, still = standing()
    jump = check_log(times, moved(0, 0.02), FREE).findings  # 2 rad/s for one tick
    assert jump["joint velocity"].violations == 1
    assert jump["joint velocity"].worst == pytest.approx(2.0)
    assert jump["joint acceleration"].violations == 2
    assert jump["joint jerk"].violations > 0
    outside = check_log(times, moved(1, 2.3), FREE).findings
    assert outside["joint room"].violations == 20
    assert outside["TCP speed"].violations == 1
    folded = still.copy()
    folded[20:, 3] = 0.1
    assert check_log(times, folded, FREE).findings["self distance"].violations > 0
    sunk = ServoConfig(table_height=0.26)  # home has link_tcp at 0.25 m
    found = check_log(times, still, sunk, widths=np.full(40, 0.0)).findings
    assert found["finger height"].violations == 40
    assert found["box room"].violations == 0
    small = ServoConfig(box_lower=(0.2, -0.4, 0.3))
    assert check_log(times, still, small).findings["box room"].violations == 40


def test_a_log_that_is_none_is_refused() -> None:
    times, q = standing()
    with pytest.raises(ValueError, match="positions: shape"):
        check_log(times, q[:, :6])
    with pytest.raises(ValueError, match="rising"):
        check_log(times[::-1], q)
    q[5, 2] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        check_log(times, q)
