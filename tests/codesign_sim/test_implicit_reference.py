"""The implicit reference solver against known answers, and the simulator against it."""

import numpy as np
import pytest
from implicit_contact import STIFFNESS, Box, Contact, SampledBox, Table
from implicit_reference import Elasticity, ImplicitBlock
from scipy.spatial.transform import Rotation
from small_block import around

from codesign_sim import Block, Material, Simulator

BLOCK = Block.tofu(600)
NODES = BLOCK.nodes + np.array([0, 0, BLOCK.size[2] / 2])  # standing on the table
E, NU, RHO, MU = 9e3, 0.3125, 1020.0, 0.5
PAD = np.array([0.010, 0.005, 0.025])  # half edges, m
OPEN, CLOSED, LIFT = 0.034, 0.026, 0.02  # m


def elasticity(nodes=NODES):
    return Elasticity(nodes, BLOCK.tetrahedra, E, NU)


# ------------------------------------------------------------------ the reference itself


def test_uniaxial_compression():
    """Smooth plates close by 1.5 mm: sigma = E gap / (L + 2 E / k), everywhere."""
    half = np.array([0.05, 0.005, 0.05])
    places = [0, BLOCK.size[1] / 2 + half[1], 0]
    plates = [
        Contact(Box(half), np.multiply(side, places), BLOCK.surface_triangles, BLOCK.nodes, 0.0)
        for side in (1, -1)
    ]
    block = ImplicitBlock(elasticity(BLOCK.nodes), BLOCK.nodes, RHO, plates, np.zeros(3))
    for _ in range(30):
        plates[0].origin -= [0, 0.25e-4, 0]
        plates[1].origin += [0, 0.25e-4, 0]
        block.step(0.02)
    for _ in range(10):
        block.step(0.1)
    stress = E * 1.5e-3 / (BLOCK.size[1] + 2 * E / STIFFNESS)
    assert block.elasticity.von_mises(block.x) == pytest.approx(stress, rel=1e-4)
    assert block.contact_force(0)[1] == pytest.approx(-stress * 0.05 * 0.04, rel=1e-4)
    assert np.ptp(block.x[:, 0]) / 0.05 - 1 == pytest.approx(NU * stress / E, rel=1e-4)


def test_rigid_rotation_is_free_of_stress():
    turned = Rotation.from_rotvec([1.0, -1.5, 1.4]).apply(NODES)
    assert np.abs(elasticity().forces(turned)).max() < 1e-12
    assert elasticity().von_mises(turned).max() < 1e-8


def test_stiffness_is_the_derivative_of_the_forces():
    rng = np.random.default_rng(1)
    x = NODES * [1.1, 0.9, 1.0] + rng.normal(size=NODES.shape) * 5e-4
    way, h = rng.normal(size=x.shape), 1e-7
    expected = (elasticity().forces(x - h * way) - elasticity().forces(x + h * way)) / (2 * h)
    found = (elasticity().stiffness(x) @ way.ravel()).reshape(-1, 3)
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize("size", [1e-5, 1e-3])  # sticking, sliding
def test_contact_stiffness_is_the_derivative_of_its_forces(size):
    rng = np.random.default_rng(2)
    contact = Contact(Table(), np.zeros(3), BLOCK.surface_triangles, NODES, MU)
    sunk = NODES - [0, 0, 1e-3]
    contact.keep(contact.touch(sunk))
    x = sunk + [size, 0, 0] + rng.normal(size=NODES.shape) * size / 10
    way, h = rng.normal(size=x.shape), 1e-8

    def forces(x):
        return contact.node_forces(contact.touch(x))

    expected = (forces(x - h * way) - forces(x + h * way)) / (2 * h)
    found = (contact.node_stiffness(contact.touch(x)) @ way.ravel()).reshape(-1, 3)
    assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()


def test_sampled_box_is_exact_on_its_faces():
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (200, 3)) * (PAD - 2e-3)
    points[:, 1] = PAD[1] - rng.uniform(0, 9e-4, 200)
    for exact, sampled in zip(Box(PAD).depth(points), SampledBox(PAD).depth(points), strict=True):
        assert np.allclose(exact, sampled, atol=1e-12)


# ------------------------------------------------------------ the simulator against it


def held_implicitly(pad: Box, dt: float) -> ImplicitBlock:
    """Settles, closes from 34 to 26 mm in 0.5 s, lifts by 20 mm in 0.2 s, holds."""
    contacts = [
        Contact(shape, origin, BLOCK.surface_triangles, NODES, MU)
        for shape, origin in (
            (pad, [0, OPEN / 2 + PAD[1], 0.026]),
            (pad, [0, -OPEN / 2 - PAD[1], 0.026]),
            (Table(), [0, 0, 0]),
        )
    ]
    block = ImplicitBlock(elasticity(), NODES, RHO, contacts)
    closing = np.array([0, (OPEN - CLOSED) / 2, 0])
    for duration, left in ((0.2, 0), (0.5, -closing), (0.1, 0), (0.2, [0, 0, LIFT]), (0.4, 0)):
        steps = round(duration / dt)
        for _ in range(steps):
            contacts[0].origin += np.divide(left, steps)
            contacts[1].origin += np.multiply(left, [1, -1, 1]) / steps
            block.step(dt)
    return block


@pytest.fixture(scope="module")
def held_explicitly(pads):
    """Top-10 % mean and median in Pa, and the normal force in N, of the same motion."""
    simulator = Simulator(BLOCK, pads)
    simulator.reset(Material(E, NU, RHO, MU), fingers=around(OPEN))
    simulator.advance(0.5, around(CLOSED))
    simulator.advance(0.1)
    simulator.advance(0.2, around(CLOSED, height=0.026 + LIFT))
    simulator.advance(0.8)
    figures = []
    for _ in range(20):  # 0.2 s, four periods of what the abrupt stop leaves
        simulator.advance(0.01)
        stress = simulator.stress()
        figures.append([stress.top10_mean[0], stress.median[0], simulator.contact().left[0, 1]])
    return np.mean(figures, axis=0)


# The simulator samples distances every 1 mm, which rounds the pad's edges. Where the reference
# does the same, both solve one problem. With sharp edges the median is 2.2 % higher.
@pytest.mark.parametrize(
    ("pad", "tolerances"),
    [(SampledBox(PAD), (0.02, 0.02, 0.02)), (Box(PAD), (0.02, 0.03, 0.04))],
    ids=["same distances", "sharp edges"],
)
def test_held_stress_agrees_with_the_simulator(held_explicitly, pad, tolerances):
    block = held_implicitly(pad, dt=0.05)
    von_mises = np.sort(block.elasticity.von_mises(block.x))
    top = von_mises[-len(von_mises) // 10 :].mean()
    carried = block.contact_force(0)[2] + block.contact_force(1)[2]
    assert carried == pytest.approx(RHO * BLOCK.volume * 9.81, rel=1e-3)
    reference = [top, np.median(von_mises), -block.contact_force(0)[1]]
    for figure, expected, tolerance in zip(held_explicitly, reference, tolerances, strict=True):
        assert figure == pytest.approx(expected, rel=tolerance)
