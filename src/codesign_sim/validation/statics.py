"""Blocks at rest: compressed between plates, and under their own weight."""

from __future__ import annotations

import numpy as np

from codesign_sim.block import Block
from codesign_sim.fingers import FingerTargets
from codesign_sim.material import Material
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.simulator import CONTACT_STIFFNESS, Simulator
from codesign_sim.validation.check import Check

GRAVITY = 9.81


def squeeze() -> list[Check]:
    """Frictionless plates close from 30 to 28.5 mm: uniform uniaxial compression.

    Block and penalty layer act in series, so sigma = E gap / (length + 2 E / k). Linear elements
    and the quadrature hold a uniform state exactly: what is left is rounding (float32 strains
    of 1e-6) and the vibration not yet damped, hence 0.1 %.
    """
    block, material = Block.tofu(2400), Material(friction=0.0)
    plates = (
        SurfaceMesh.box((-0.05, 0.0, -0.05), (0.05, 0.01, 0.05)),
        SurfaceMesh.box((-0.05, -0.01, -0.05), (0.05, 0.0, 0.05)),
    )
    simulator = Simulator(block, plates, table_height=None, gravity=(0, 0, 0))
    centre = (0.0, 0.0, block.size[2] / 2)
    simulator.reset(material, fingers=FingerTargets.from_above(centre, 0.030))
    simulator.advance(0.3, FingerTargets.from_above(centre, 0.0285))
    simulator.advance(1.0)

    length, area = block.size[1], block.size[0] * block.size[2]
    stress = (
        material.young_modulus * 0.0015 / (length + 2 * material.young_modulus / CONTACT_STIFFNESS)
    )
    strain = stress / material.young_modulus
    force = simulator.contact().left[0, 1]
    wider = [_side_distance(simulator, axis) / block.size[axis] - 1 for axis in range(3)]
    von_mises = simulator.stress().von_mises[0]
    farthest = von_mises[np.argmax(np.abs(von_mises - stress))]
    lateral = material.poisson_ratio * strain
    return [
        Check("squeeze force", stress * area, force, 1e-3 * stress * area, "N"),
        Check("squeeze stress, farthest tetrahedron", stress, farthest, 1e-3 * stress, "Pa"),
        Check("squeeze lateral strain x", lateral, wider[0], 1e-3 * lateral, ""),
        Check("squeeze lateral strain z", lateral, wider[2], 1e-3 * lateral, ""),
    ]


def _side_distance(simulator: Simulator, axis: int) -> float:
    """Distance of the centres of two opposite sides, m; a free turn of the block cancels."""
    along = simulator.rest_positions[:, axis]
    x = simulator.positions[0]
    low, high = along < along.min() + 1e-9, along > along.max() - 1e-9
    return float(np.linalg.norm(x[high].mean(axis=0) - x[low].mean(axis=0)))


def resting() -> list[Check]:
    """The tofu rests on the table, which carries its weight.

    The force is a mean over 0.1 s; 0.1 % covers what still vibrates. The stress figures have no
    closed form (the base sticks); they are compared with an independent implementation's 302 and
    184 Pa to 3 %, the spread between ways of letting the block settle.
    """
    block, material = Block.tofu(2400), Material()
    simulator = Simulator(block)
    simulator.reset(material)
    simulator.advance(0.1)
    weight = material.density * block.volume * GRAVITY
    stress = simulator.stress()
    return [
        Check("resting table force", weight, simulator.contact().table[0, 2], 1e-3 * weight, "N"),
        Check("resting top-10 % stress", 302, stress.top10_mean[0], 0.03 * 302, "Pa"),
        Check("resting mean stress", 184, stress.mean[0], 0.03 * 184, "Pa"),
    ]


def layers() -> list[Check]:
    """A column of nu = 0 on a smooth table: sigma = rho g (h - z), sag rho g h^2 / 2E.

    With nu = 0 this is the exact solution on a flat base. The sag adds the penetration
    rho g h / k. Linear elements are exact at the nodes of a column and hold the mean stress of a
    layer; the five-tetrahedra split spreads single elements, so layer means are compared, to 1 %
    of the greatest stress.
    """
    block, material = Block.tofu(2400), Material(poisson_ratio=0.0, friction=0.0)
    simulator = Simulator(block)
    simulator.reset(material)
    simulator.advance(0.1)
    height, weight = block.size[2], material.density * GRAVITY
    top = block.nodes[:, 2] > height / 2 - 1e-9
    sag = height - simulator.positions[0, top, 2].mean()
    expected_sag = weight * height**2 / (2 * material.young_modulus)
    expected_sag += weight * height / CONTACT_STIFFNESS
    layer = np.repeat(np.arange(block.resolution // 5) // (block.cells[0] * block.cells[1]), 5)
    count = block.cells[2]
    expected = weight * height * (count - np.arange(count) - 0.5) / count
    volumes = np.bincount(layer, block.volumes)
    mean = np.bincount(layer, block.volumes * simulator.stress().von_mises[0]) / volumes
    worst = int(np.argmax(np.abs(mean - expected)))
    return [
        Check("layers sag", expected_sag, sag, 0.01 * expected_sag, "m"),
        Check(
            f"layers stress, layer {worst + 1} of {count}",
            expected[worst],
            mean[worst],
            0.01 * weight * height,
            "Pa",
        ),
    ]
