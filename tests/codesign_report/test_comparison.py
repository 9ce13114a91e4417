"""Grippers against the one that they are measured by: ratios with known answers."""

import math

import pytest

from codesign_policy.metrics import GraspMetrics
from codesign_report.comparison import Labelled, compare


def trial(gripper: str, seed: int, top10: float, median: float, success: bool = True) -> Labelled:
    metrics = GraspMetrics(success, top10, median, 0.1, 0.6, 5.0, 990.0)
    return Labelled(gripper, seed, metrics)


def test_means_spread_and_ratios() -> None:
    ours, base = compare(
        [
            trial("original", 0, 900.0, 500.0),
            trial("codesign", 0, 600.0, 200.0),
            trial("original", 1, 1100.0, 700.0, success=False),
            trial("codesign", 1, 800.0, 100.0),
        ]
    )
    assert (ours.gripper, ours.trials, ours.success_rate) == ("codesign", 2, 1.0)
    assert (ours.top10, ours.median) == ((700.0, 100.0), (150.0, 50.0))
    assert ours.baseline == "original"
    assert ours.top10_ratio == pytest.approx(0.7)
    assert ours.median_ratio == pytest.approx(0.25)
    assert ours.score == pytest.approx(1000.0 - 700.0 / 200.0)
    assert (base.gripper, base.success_rate, base.baseline) == ("original", 0.5, "")
    assert math.isnan(base.top10_ratio)


def test_only_seeds_that_both_have_are_compared() -> None:
    ours, base = compare(
        [trial("a", 0, 500.0, 1.0), trial("a", 1, 9000.0, 1.0), trial("stock", 0, 1000.0, 2.0)]
    )
    assert (ours.top10_ratio, ours.median_ratio) == (0.5, 0.5)
    assert base.gripper == "stock"
    (apart, _) = compare([trial("a", 0, 500.0, 1.0), trial("stock", 3, 1000.0, 2.0)])
    assert math.isnan(apart.top10_ratio)


def test_without_a_yardstick_nothing_is_compared() -> None:
    for trials in (
        [trial("stock", 0, 9.0, 1.0)],
        [trial("a", 0, 9.0, 1.0), trial("b", 0, 9.0, 1.0)],
    ):
        assert {result.baseline for result in compare(trials)} == {""}


def test_the_paper_s_original_comes_before_the_stock_one() -> None:
    names = [compare([trial(n, 0, 1.0, 1.0) for n in ("stock", "original", "x")])]
    assert [(r.gripper, r.baseline) for r in names[0]] == [
        ("stock", "original"),
        ("x", "original"),
        ("original", ""),
    ]


def test_a_finger_that_never_touched_has_no_stress() -> None:
    missed = trial("a", 0, math.nan, math.nan, success=False)
    base = [trial("original", 0, 4000.0, 1.0), trial("original", 1, 1000.0, 1.0)]
    ours, _ = compare([missed, trial("a", 1, 500.0, 100.0), *base])
    assert ours.top10 == (500.0, 0.0)
    assert ours.top10_ratio == 0.5  # of the seed on which both touched
    ours, _ = compare([missed, *base])
    assert math.isnan(ours.top10_ratio)
