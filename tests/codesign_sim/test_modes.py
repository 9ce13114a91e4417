"""One physics, whatever the vectors hold: items, 8 or 16 environments, or a team of threads."""

import numpy as np
import pytest
from small_block import SMALL, around

from codesign_sim import Material, Simulator, SurfaceMesh, kernels, simulator

LEDGE = SurfaceMesh.box((-0.01, 0.0, 0.01), (0.01, 0.02, 0.02))  # reaches under the block


def grasp(pads, count: int = 3, device: str = "cpu") -> Simulator:
    """Blocks of different stiffness, turned, squeezed and lifted."""
    sim = Simulator(SMALL, pads, count, device=device)
    materials = [Material(young_modulus=8e3 + 1e3 * k) for k in range(count)]
    sim.reset(materials, yaw=0.2 * np.arange(count), fingers=around(0.034, environments=count))
    sim.advance(0.1, around(0.027, environments=count))
    sim.advance(0.05, around(0.027, height=0.036, environments=count))
    return sim


def grasped(monkeypatch, pads, mode: int) -> Simulator:
    monkeypatch.setattr(kernels, "mode_for", lambda environments, device: mode)
    return grasp(pads)


@pytest.mark.parametrize("mode", [kernels.TEAM, 8, 16])
def test_all_modes_agree_to_rounding(monkeypatch, pads, mode):
    expected, sim = grasped(monkeypatch, pads, 1), grasped(monkeypatch, pads, mode)
    np.testing.assert_allclose(sim.positions, expected.positions, atol=2e-7)
    np.testing.assert_allclose(sim.velocities, expected.velocities, atol=2e-5)
    np.testing.assert_allclose(sim.contact().left, expected.contact().left, atol=2e-4)
    np.testing.assert_allclose(
        sim.contact().finger_penetration, expected.contact().finger_penetration, atol=2e-7
    )
    np.testing.assert_allclose(sim.stress().von_mises, expected.stress().von_mises, atol=0.5)
    np.testing.assert_allclose(sim.elastic_forces(), expected.elastic_forces(), atol=2e-5)
    assert expected.contact().left[:, 1].min() > 0.3  # newtons: they do hold it


def test_a_team_gives_the_same_bits_again(monkeypatch, pads):
    first, second = (grasped(monkeypatch, pads, kernels.TEAM) for _ in range(2))
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.contact().left, second.contact().left)


def test_the_elastic_forces_of_a_team_leave_out_its_contacts(monkeypatch, pads):
    sim = grasped(monkeypatch, pads, kernels.TEAM)
    again = grasped(monkeypatch, pads, kernels.TEAM)
    weight_of_rounding = np.abs(sim.elastic_forces().sum(axis=1)).max()
    assert weight_of_rounding < 1e-4  # newtons; contact forces are above 0.3
    for one in (sim, again):
        one.advance(0.01)
    np.testing.assert_array_equal(sim.positions, again.positions)


@pytest.mark.parametrize("mode", [1, 8, kernels.TEAM])
@pytest.mark.parametrize("seed", range(3))
def test_what_is_far_from_the_fingers_is_left_out_without_missing_a_contact(
    monkeypatch, pads, mode, seed
):
    """Any motion, any state: the same bits as when every triangle counts as near."""
    runs = []
    for skin in (simulator.CONTACT_SKIN, 1.0):
        monkeypatch.setattr(simulator, "CONTACT_SKIN", skin)
        monkeypatch.setattr(kernels, "mode_for", lambda environments, device: mode)
        rng = np.random.default_rng(seed)
        ledges = (LEDGE, SurfaceMesh(LEDGE.vertices * [1, -1, 1], LEDGE.faces[:, ::-1]))
        sim = Simulator(SMALL, [pads, ledges, pads, ledges], 4)
        sim.reset(Material(), yaw=rng.uniform(-1, 1, 4), fingers=around(0.04, environments=4))
        speeds = rng.normal(0, 0.5, (4, 1, 3)) + rng.normal(0, 0.5, (4, len(SMALL.nodes), 3))
        sim.set_state(sim.positions, speeds)
        forces = []
        for _ in range(6):
            width, height = rng.uniform(0.02, 0.04), rng.uniform(0.0, 0.04)
            sim.advance(0.03, around(width, height=height, environments=4))
            contact = sim.contact()
            forces.append([contact.left, contact.right, contact.table])
        runs.append((np.array(forces), sim.positions))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    assert np.abs(runs[0][0]).max() > 1  # newtons: there were contacts to be missed


def test_vectors_are_as_wide_as_the_processor_allows_and_the_environments_need(monkeypatch):
    cpu = kernels.find_device("cpu")
    monkeypatch.setattr(kernels, "vector_lanes", lambda: (16, 8))
    modes = [kernels.mode_for(count, cpu) for count in (1, 3, 4, 8, 9, 64)]
    assert modes == [1, 1, 8, 8, 16, 16]
    monkeypatch.setattr(kernels, "vector_lanes", lambda: (8,))
    assert kernels.mode_for(64, cpu) == 8


@pytest.mark.parametrize(
    ("flags", "lanes"), [("fpu avx2 avx512f sse", (16, 8)), ("fpu avx2", (8,)), (None, (8,))]
)
def test_vector_lanes_follow_the_flags_of_the_processor(monkeypatch, tmp_path, flags, lanes):
    info = tmp_path / "cpuinfo"
    if flags:
        info.write_text(f"processor : 0\nflags : {flags} \n")
    monkeypatch.setattr(kernels, "_CPU_INFO", info)
    assert kernels.vector_lanes.__wrapped__() == lanes
