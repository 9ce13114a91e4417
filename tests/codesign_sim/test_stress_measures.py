"""Stress of known deformations, and its statistics."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_block import SMALL

from codesign_sim import Material, Simulator, StressMeasure
from codesign_sim.stress import summarise


def deform(simulator, gradient, shift=(0.0, 0.0, 0.0)):
    positions = simulator.rest_positions @ np.asarray(gradient).T + np.asarray(shift)
    simulator.set_state(positions[None], np.zeros_like(positions)[None])


@pytest.mark.parametrize("stretch", [0.1, -0.1, 0.3])
def test_uniaxial_strain(floating, stretch):
    # F = diag(1 + e, 1, 1): P = diag((2 mu + lambda) e, lambda e, lambda e).
    deform(floating, np.diag([1 + stretch, 1, 1]))
    mu, lam = Material().lame
    corotated = floating.stress(StressMeasure.COROTATED).von_mises
    assert corotated == pytest.approx(2 * mu * abs(stretch), rel=1e-4)
    # Cauchy P F^T / J: the area across the stretch stays, the one along it grows by 1 + e.
    expected = abs((2 * mu + lam) * stretch - lam * stretch / (1 + stretch))
    assert floating.stress(StressMeasure.CAUCHY).von_mises == pytest.approx(expected, rel=1e-4)


def test_simple_shear_of_a_small_angle(floating):
    deform(floating, [[1, 0.01, 0], [0, 1, 0], [0, 0, 1]])
    expected = np.sqrt(3) * Material().lame[0] * 0.01
    assert floating.stress().von_mises == pytest.approx(expected, rel=0.01)


def test_pressure_has_no_von_mises_stress(floating):
    deform(floating, 0.9 * np.eye(3))
    assert floating.stress().von_mises.max() < 0.1


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_stress_does_not_change_under_rigid_motion(seed):
    simulator = Simulator(SMALL, table_height=None, gravity=(0, 0, 0))
    simulator.reset(Material())
    rng = np.random.default_rng(seed)
    gradient = np.eye(3) + rng.uniform(-0.15, 0.15, (3, 3))
    turn = Rotation.random(random_state=seed).as_matrix()
    for measure in StressMeasure:
        deform(simulator, gradient)
        before = simulator.stress(measure).von_mises
        deform(simulator, turn @ gradient, rng.uniform(-0.1, 0.1, 3))
        after = simulator.stress(measure).von_mises
        assert np.allclose(before, after, rtol=1e-4, atol=0.2)


def test_summary_of_known_values():
    values = np.arange(1.0, 101.0)[None]
    volumes = np.ones(100)
    volumes[99] = 2.0
    summary = summarise(values, volumes, StressMeasure.CAUCHY)
    assert summary.top10_mean[0] == pytest.approx(95.5)
    assert summary.median[0] == pytest.approx(50.5)
    assert summary.mean[0] == pytest.approx((5050 + 100) / 101)


def test_measure_may_be_given_by_name(floating):
    assert floating.stress("cauchy").measure is StressMeasure.CAUCHY
    with pytest.raises(ValueError, match="tresca"):
        floating.stress("tresca")
