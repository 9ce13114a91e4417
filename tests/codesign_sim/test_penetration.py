"""The reported depth of contact against known answers, and what thin lips can carry."""

import numpy as np
import pytest
from small_block import around
from test_closing_limit import mirrored, scoop

from codesign_sim import Block, Material, Simulator, SurfaceMesh
from codesign_sim.fingers import rotation_matrix
from codesign_sim.simulator import CONTACT_STIFFNESS

BLOCK = Block.tofu(600)
POINTS = np.full((3, 3), 1 / 6) + np.eye(3) / 2  # where a triangle is in contact


def depth_below(simulator, half_width):
    """Greatest depth of the contact points below pads of 2 half_width x 50 mm, by geometry."""
    at, corners = simulator.fingers, simulator.positions[0][simulator.surface_triangles]
    points = np.einsum("qc,tck->tqk", POINTS, corners).reshape(-1, 3) - at.position[0]
    points = points @ rotation_matrix(at.quaternion)[0]
    deepest = 0.0
    for side in (1, -1):
        beyond = side * points[:, 1] - at.width[0] / 2
        faces = [beyond, 0.01 - beyond]
        faces += [half_width - np.abs(points[:, 0]), 0.025 - np.abs(points[:, 2])]
        deepest = max(deepest, np.min(faces, axis=0).max())
    return deepest


def test_uniform_squeeze_presses_in_by_pressure_over_stiffness():
    plates = SurfaceMesh.box((-0.04, 0.0, -0.04), (0.04, 0.01, 0.04))
    simulator = Simulator(BLOCK, (plates, mirrored(plates)), table_height=None, gravity=(0, 0, 0))
    material = Material(friction=0.0)
    simulator.reset(material)
    width, length = 0.028, BLOCK.size[1]
    simulator.advance(0.01, around(width, height=0.02))
    simulator.settle(0.5, 100.0)
    modulus = material.young_modulus
    # Block and two contact layers in series; to a percent, as the strain is not small.
    pressure = modulus * (length - width) / (length + 2 * modulus / CONTACT_STIFFNESS)
    expected = pressure / CONTACT_STIFFNESS
    assert simulator.contact().finger_penetration[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("width", [0.028, 0.026, 0.022])
def test_pads_with_sharp_edges(pads, width):
    simulator = Simulator(BLOCK, pads)
    simulator.reset(Material(), fingers=around(0.034))
    simulator.advance(0.3, around(width))
    simulator.advance(0.3)
    expected = depth_below(simulator, 0.01)
    assert 2e-4 < expected < 1.5e-3
    # Exact where a point is nearest to the pad's face; the edge is rounded in the last cell.
    assert simulator.contact().finger_penetration[0] == pytest.approx(expected, abs=5e-5)


def carried_by_lips(thickness, shift):
    """Share of its weight that lips 7 mm under the block carry, as far as the pads leave it."""
    lip = scoop(0.01, thickness)
    vertices = lip.vertices.copy()
    vertices[vertices[:, 2] < -0.02, 2] -= shift  # moves the lip against the grid's planes
    left = SurfaceMesh(vertices, lip.faces)
    simulator = Simulator(BLOCK, (left, mirrored(left)))
    simulator.reset(Material(friction=0.3), fingers=around(0.034, height=0.03))
    raised = simulator.positions + np.array([0, 0, 0.005 + thickness])
    simulator.set_state(raised, np.zeros_like(raised))
    simulator.advance(0.5)
    contact = simulator.contact()
    weight = 1020 * BLOCK.volume * 9.81
    return (contact.left[0, 2] + contact.right[0, 2]) / weight


@pytest.mark.parametrize("shift", [0.0, 2.5e-4, 5e-4])
def test_lips_just_thick_enough_carry_the_block(shift):
    assert carried_by_lips(0.0025, shift) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("thickness", [0.0015, 0.0003])
def test_thinner_lips_are_told_of_since_the_block_passes_them(thickness):
    with pytest.warns(UserWarning, match="the block may pass through them"):
        share = carried_by_lips(thickness, 0.0)
    assert share < 0.9
