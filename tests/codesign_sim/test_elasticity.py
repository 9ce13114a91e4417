"""Elastic forces of large deformations against the polar decomposition by singular values."""

import numpy as np
import pytest
from small_block import SMALL

from codesign_sim import Material, Simulator


def expected_forces(block, positions: np.ndarray, material: Material) -> np.ndarray:
    """-dE/dx of mu |F - R|^2 + lambda/2 tr(S - I)^2, with R the nearest rotation."""
    mu, lam = material.lame
    x = positions[block.tetrahedra]
    edges = np.transpose(x[:, 1:] - x[:, :1], (0, 2, 1))
    deformation = edges @ block.inverse_edges
    u, s, vt = np.linalg.svd(deformation)
    mirrored = np.linalg.det(u @ vt)
    u[:, :, 2] *= mirrored[:, None]
    s[:, 2] *= mirrored
    rotation = u @ vt
    trace = s.sum(axis=1) - 3
    piola = 2 * mu * (deformation - rotation) + lam * trace[:, None, None] * rotation
    pull = -block.volumes[:, None, None] * piola @ np.transpose(block.inverse_edges, (0, 2, 1))
    corners = np.concatenate([-pull.sum(axis=2, keepdims=True), pull], axis=2)
    forces = np.zeros_like(positions)
    np.add.at(forces, block.tetrahedra, np.transpose(corners, (0, 2, 1)))
    return forces


# Noise in cells of 10 mm; at 0.6 many are inside out. Stretched a hundredfold and inside out, the
# nearest rotation hangs on the last bits.
@pytest.mark.parametrize(
    ("stretch", "noise"),
    [*((s, n) for s in (0.3, 1.0, 4.0) for n in (0.02, 0.2, 0.6)), (100.0, 0.02), (100.0, 0.2)],
)
def test_forces_of_large_deformations(stretch, noise):
    rng = np.random.default_rng(0)
    material = Material()
    sim = Simulator(SMALL, table_height=None, environments=8)
    sim.reset(material)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    shape = SMALL.nodes * [stretch, 1.0, 1.0] + noise * 0.01 * rng.standard_normal(
        (8, *SMALL.nodes.shape)
    )
    sim.set_state(shape @ turn.T, np.zeros_like(shape))
    for found, positions in zip(sim.elastic_forces(), shape @ turn.T, strict=True):
        expected = expected_forces(SMALL, positions, material)
        assert np.abs(found - expected).max() < 3e-4 * np.abs(expected).max()


def test_forces_do_not_depend_on_what_neighbours_need():
    """Mild strains, which take the short way, beside neighbours as mild and inside out."""
    rng = np.random.default_rng(1)
    noise = 1e-3 * rng.standard_normal((8, *SMALL.nodes.shape))
    sim = Simulator(SMALL, table_height=None, environments=8)
    sim.reset()
    found = []
    for neighbours in (1.0, 6.0):
        scale = np.array([1.0] + 7 * [neighbours])[:, None, None]
        sim.set_state(SMALL.nodes + scale * noise, np.zeros_like(noise))
        found.append(sim.elastic_forces())
    np.testing.assert_array_equal(found[0][0], found[1][0])
    for forces, scale in zip(found, (1.0, 6.0), strict=True):
        expected = expected_forces(SMALL, SMALL.nodes + scale * noise[1], Material())
        assert np.abs(forces[1] - expected).max() < 3e-4 * np.abs(expected).max()


# Strains of some 10, 30 and 50 %: the short way, both ways, the long way.
@pytest.mark.parametrize("noise", [4e-4, 1e-3, 2e-3])
def test_forces_of_moderate_strains_are_right_to_single_precision(noise):
    rng = np.random.default_rng(2)
    shape = SMALL.nodes + noise * rng.standard_normal((8, *SMALL.nodes.shape))
    sim = Simulator(SMALL, table_height=None, environments=8)
    sim.reset()
    sim.set_state(shape, np.zeros_like(shape))
    for found, positions in zip(sim.elastic_forces(), shape, strict=True):
        expected = expected_forces(SMALL, positions, Material())
        assert np.abs(found - expected).max() < 3e-6 * np.abs(expected).max()
