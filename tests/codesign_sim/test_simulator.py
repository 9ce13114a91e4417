"""Forces, motion and contact of the simulator."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_block import SMALL, around

from codesign_sim import FingerTargets, Material, SimulationError, Simulator, SurfaceMesh

WEIGHT = 1020 * 0.05 * 0.03 * 0.04 * 9.81


def test_rest_shape_carries_no_force(floating):
    # Rounding: E times areas of 1e-4 m^2 times strains of 1e-6.
    assert np.abs(floating.elastic_forces()).max() < 1e-6


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_elastic_forces_have_no_resultant(seed):
    simulator = Simulator(SMALL, table_height=None, gravity=(0, 0, 0))
    simulator.reset(Material())
    rng = np.random.default_rng(seed)
    rest = simulator.rest_positions
    bent = rest @ (np.eye(3) + rng.uniform(-0.2, 0.2, (3, 3))).T
    bent += rng.uniform(-0.001, 0.001, rest.shape)
    simulator.set_state(bent[None], np.zeros_like(bent)[None])
    force = simulator.elastic_forces()[0]
    assert np.abs(force).max() > 1e-3
    assert np.allclose(force.sum(axis=0), 0, atol=2e-5)
    assert np.allclose(np.cross(bent, force).sum(axis=0), 0, atol=1e-6)


def test_elastic_forces_are_the_slope_of_the_energy(floating):
    rng = np.random.default_rng(5)
    rest = floating.rest_positions
    bent = rest @ (np.eye(3) + rng.uniform(-0.1, 0.1, (3, 3))).T
    bent += rng.uniform(-5e-4, 5e-4, rest.shape)
    floating.set_state(bent[None], np.zeros_like(bent)[None])
    force = floating.elastic_forces()[0]
    for _ in range(5):
        way = rng.standard_normal(rest.shape)
        step = 1e-7
        slope = (energy(bent + step * way) - energy(bent - step * way)) / (2 * step)
        assert -slope == pytest.approx((force * way).sum(), rel=1e-3, abs=1e-4)


def energy(x):
    """Co-rotated energy of the small block by singular values, in double precision."""
    mu, lam = Material().lame
    corners = x[SMALL.tetrahedra]
    edges = np.transpose(corners[:, 1:] - corners[:, :1], (0, 2, 1))
    strain = np.linalg.svd(edges @ SMALL.inverse_edges, compute_uv=False) - 1
    density = mu * (strain**2).sum(axis=1) + lam / 2 * strain.sum(axis=1) ** 2
    return (density * SMALL.volumes).sum()


def test_a_turned_over_block_finds_back(floating):
    # Mirrored: every tetrahedron inside out. It must neither stay so nor fly apart.
    rest = floating.rest_positions
    mirrored = rest * [1, -0.5, 1] + np.random.default_rng(0).uniform(-1e-4, 1e-4, rest.shape)
    floating.set_state(mirrored[None], np.zeros_like(rest)[None])
    floating.settle(1.0, 50.0)
    assert floating.stress().von_mises.max() < 1.0


def test_free_fall(pads):
    simulator = Simulator(SMALL, table_height=None)
    simulator.reset(Material())
    simulator.advance(0.1)
    mean = SMALL.node_volumes / SMALL.volume
    assert simulator.velocities[0, :, 2] @ mean == pytest.approx(-0.981, rel=1e-4)
    centre, quaternion = simulator.object_pose()
    # Symplectic Euler falls half a step of velocity farther than g t^2 / 2.
    expected = 0.02 - 0.5 * 9.81 * 0.1**2 - 0.5 * 0.981 * simulator.time_step
    assert centre[0, 2] == pytest.approx(expected, abs=2e-5)
    assert np.allclose(np.abs(quaternion[0, 3]), 1, atol=1e-6)


def test_reset_rests_on_the_table_where_told():
    simulator = Simulator(SMALL, table_height=0.2)
    simulator.reset(Material(), position=(0.4, -0.1), yaw=0.5)
    simulator.advance(0.05)
    centre, quaternion = simulator.object_pose()
    assert centre[0] == pytest.approx([0.4, -0.1, 0.2195], abs=2e-4)
    assert Rotation.from_quat(quaternion[0]).as_rotvec() == pytest.approx([0, 0, 0.5], abs=1e-3)
    assert simulator.contact().table[0] == pytest.approx([0, 0, WEIGHT], abs=1e-3 * WEIGHT)
    assert np.abs(simulator.velocities).max() < 1e-4  # it does not bounce
    assert simulator.time == pytest.approx(0.05)


def test_contact_impulse_is_the_change_of_momentum(pads):
    simulator = Simulator(SMALL, pads)
    simulator.reset(Material(), fingers=around(0.031))
    mass = 1020 * SMALL.node_volumes
    for width, height in ((0.027, 0.026), (0.026, 0.03), (0.026, 0.04)):
        before = mass @ simulator.velocities[0]
        simulator.advance(0.05, around(width, height))
        contact = simulator.contact()
        force = contact.left + contact.right + contact.table - np.array([0, 0, WEIGHT])
        change = mass @ simulator.velocities[0] - before
        assert change == pytest.approx(0.05 * force[0], abs=2e-6)


def test_fingers_lift_the_block(grasped):
    grasped.advance(0.3)
    contact = grasped.contact()
    assert contact.table[0, 2] == 0
    assert contact.left[0, 2] + contact.right[0, 2] == pytest.approx(WEIGHT, rel=0.05)
    assert contact.left[0, 1] == pytest.approx(-contact.right[0, 1], rel=0.01)
    assert 1e-5 < contact.finger_penetration[0] < 1e-3


def test_fingers_without_friction_slip(pads):
    simulator = Simulator(SMALL, pads)
    simulator.reset(Material(friction=0.0), fingers=around(0.034))
    simulator.advance(0.2, around(0.026))
    simulator.advance(0.2, around(0.026, height=0.046))
    assert simulator.contact().table[0, 2] == pytest.approx(WEIGHT, rel=0.05)


def test_a_block_that_sticks_does_not_creep():
    slope = np.radians(20)
    gravity = (9.81 * np.sin(slope), 0.0, -9.81 * np.cos(slope))
    simulator = Simulator(SMALL, gravity=gravity)
    simulator.reset(Material(friction=0.5))
    simulator.settle(2.0)
    before = simulator.positions
    simulator.advance(2.0)
    assert np.abs(simulator.positions - before).max() < 2e-7


def test_a_turned_hand_turns_the_block(grasped):
    grasped.advance(0.4, FingerTargets.from_above((0, 0, 0.036), 0.026, yaw=0.3))
    grasped.advance(0.2)
    turned = Rotation.from_quat(grasped.object_pose()[1][0]).as_rotvec()
    assert turned == pytest.approx([0, 0, 0.3], abs=0.03)


def test_a_wider_finger_takes_over_after_a_swap(pads):
    simulator = Simulator(SMALL, pads)
    wide = (
        SurfaceMesh.box((-0.03, 0.0, -0.025), (0.03, 0.01, 0.025)),
        SurfaceMesh.box((-0.03, -0.01, -0.025), (0.03, 0.0, 0.025)),
    )
    force = []
    for left, right in (pads, wide, pads):
        simulator.set_fingers(left, right)
        simulator.reset(Material(), fingers=around(0.034))
        simulator.advance(0.2, around(0.027))
        simulator.advance(0.2)
        force.append(simulator.contact().left[0, 1])
    assert force[1] > 1.5 * force[0]
    assert force[2] == force[0]


def test_runs_repeat_bit_for_bit(pads):
    def run():
        simulator = Simulator(SMALL, pads)
        simulator.reset(Material(), fingers=around(0.034))
        simulator.advance(0.1, around(0.025))
        simulator.advance(0.1, around(0.025, height=0.04))
        return simulator.positions, simulator.velocities, simulator.stress().von_mises

    for first, second in zip(run(), run(), strict=True):
        assert np.array_equal(first, second)


def test_a_reset_forgets_the_trial_before(pads):
    simulator = Simulator(SMALL, pads)
    results = []
    for _ in range(2):
        simulator.reset(Material(), fingers=around(0.034))
        simulator.advance(0.1, around(0.025))
        results.append(simulator.positions)
    assert np.array_equal(*results)


def test_shorter_calls_follow_the_same_path(pads):
    simulators = [Simulator(SMALL, pads, time_step=2.5e-4) for _ in range(2)]
    for simulator in simulators:
        simulator.reset(Material(), fingers=around(0.034))
    simulators[0].advance(0.1, around(0.026))
    for k in range(1, 11):
        simulators[1].advance(0.01, around(0.034 - 0.0008 * k))
    assert np.allclose(simulators[0].positions, simulators[1].positions, atol=2e-6)


def test_first_targets_place_fingers_that_were_away(pads):
    simulator = Simulator(SMALL, pads)
    simulator.reset(Material())
    assert simulator.fingers is None
    simulator.advance(0.01, around(0.034))
    assert simulator.fingers.width[0] == 0.034
    assert np.abs(simulator.contact().left).max() == 0


def test_pinned_nodes_stay_and_loads_pull(floating):
    left = np.flatnonzero(floating.rest_positions[:, 0] < -0.0249)
    right = np.flatnonzero(floating.rest_positions[:, 0] > 0.0249)
    before = floating.positions[0]
    floating.pin(left)
    loads = np.zeros_like(before)
    loads[right, 0] = 0.1 * SMALL.node_volumes[right] / SMALL.node_volumes[right].sum()
    floating.set_loads(loads)
    floating.settle(0.5, 100.0)
    moved = floating.positions[0] - before
    assert np.abs(moved[left]).max() == 0
    # A rod: F L / E A, a little less because the clamp holds the section's width.
    assert moved[right, 0].mean() == pytest.approx(0.1 * 0.05 / (9e3 * 0.03 * 0.04), rel=0.05)


def test_a_state_that_is_not_finite_is_reported_until_reset(floating):
    floating._scene.velocities.fill_(np.nan)
    with pytest.raises(SimulationError, match="not finite after 0 s; reset"):
        floating.advance(0.01)
    with pytest.raises(SimulationError, match="not finite"):
        floating.stress()
    floating.reset(Material())
    floating.advance(0.01)
    assert np.isfinite(floating.positions).all()


def test_speeds_stay_below_the_limit(floating):
    fast = np.full((1, len(SMALL.nodes), 3), 100.0)
    floating.set_state(floating.positions, fast)
    floating.advance(0.01)
    speed = np.linalg.norm(floating.velocities, axis=2)
    assert speed.max() <= floating.top_speed * 1.0001
