"""What is drawn for a trial: ranges, repeatability, independence of what is asked for."""

import math
from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codesign_policy.domain import (
    POISSON_RATIO_RANGE,
    YOUNG_MODULUS_RANGE,
    TrialDomain,
    domain_corners,
    draw_domain,
)


@given(st.integers(0, 2**53))
def test_draws_are_in_range_and_repeat(seed: int) -> None:
    domain = draw_domain(seed)
    assert YOUNG_MODULUS_RANGE[0] <= domain.young_modulus <= YOUNG_MODULUS_RANGE[1]
    assert POISSON_RATIO_RANGE[0] <= domain.poisson_ratio <= POISSON_RATIO_RANGE[1]
    assert math.hypot(domain.x - 0.45, domain.y) <= 0.004 * math.sqrt(2)
    assert domain == draw_domain(seed)


def test_draws_fill_the_range_evenly() -> None:
    modulus = np.array([draw_domain(seed).young_modulus for seed in range(400)])
    # Mean of 400 uniform draws over 2 kPa: standard error 29 Pa.
    assert modulus.mean() == pytest.approx(9e3, abs=4 * 29)
    assert modulus.min() < 8.1e3
    assert modulus.max() > 9.9e3


@given(st.integers(0, 1000), st.floats(1e3, 1e5))
def test_a_given_value_is_kept_and_moves_no_other(seed: int, modulus: float) -> None:
    drawn = draw_domain(seed)
    asked = draw_domain(seed, TrialDomain(young_modulus=modulus))
    assert asked.young_modulus == modulus
    for field in fields(TrialDomain):
        if field.name != "young_modulus":
            assert getattr(asked, field.name) == getattr(drawn, field.name)


@pytest.mark.parametrize(
    ("name", "value"),
    [("young_modulus", -1.0), ("young_modulus", math.inf), ("poisson_ratio", 0.5),
     ("density", 0.0), ("friction", -0.1), ("y", math.inf)],
)  # fmt: skip
def test_refuses_impossible_values_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        draw_domain(0, TrialDomain(**{name: value}))


def test_refuses_a_negative_seed() -> None:
    with pytest.raises(ValueError, match="seed -1"):
        draw_domain(-1)


def test_friction_may_be_zero() -> None:
    assert draw_domain(0, TrialDomain(friction=0.0)).friction == 0.0


@given(st.integers(0, 2**31), st.floats(0.1, 0.5), st.floats(0.5, 0.9))
def test_a_range_of_friction_changes_nothing_else(seed: int, low: float, high: float) -> None:
    usual, drawn = draw_domain(seed), draw_domain(seed, friction=(low, high))
    assert low <= drawn.friction <= high
    for field in fields(TrialDomain):
        if field.name != "friction":
            assert getattr(drawn, field.name) == getattr(usual, field.name)


@given(st.integers(0, 2**31), st.floats(0.1, 0.5), st.floats(0.5, 0.9))
def test_corners_enclose_every_draw(seed: int, low: float, high: float) -> None:
    request = TrialDomain(young_modulus=9.3e3)
    lowest, highest = domain_corners(request, (low, high))
    assert lowest.young_modulus == highest.young_modulus == 9.3e3
    drawn = draw_domain(seed, request, (low, high))
    for field in fields(TrialDomain):
        value = getattr(drawn, field.name)
        assert getattr(lowest, field.name) <= value <= getattr(highest, field.name)


def test_corners_refuse_a_range_upside_down() -> None:
    with pytest.raises(ValueError, match="lower number first"):
        domain_corners(friction=(0.6, 0.4))
