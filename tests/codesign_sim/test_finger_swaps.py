"""New fingers in some environments of a running simulator."""

import warnings

import numpy as np
import pytest
from small_block import SMALL, around
from test_closing_limit import scoop

from codesign_sim import Material, Simulator, SurfaceMesh


def pads_of(half, top=0.025):
    left = SurfaceMesh.box((-half, 0.0, -0.025), (half, 0.01, top))
    return left, SurfaceMesh.box((-half, -0.01, -0.025), (half, 0.0, top))


def held(pads, environments):
    simulator = Simulator(SMALL, pads, environments)
    simulator.reset(Material(), fingers=around(0.034, environments=environments))
    simulator.advance(0.1, around(0.027, environments=environments))
    return simulator


def results(simulator, k):
    contact = simulator.contact()
    return (
        simulator.positions[k],
        simulator.velocities[k],
        simulator.stress().von_mises[k],
        contact.left[k],
        contact.finger_penetration[k],
        simulator.fingers.width[k],
    )


@pytest.mark.parametrize(("environments", "changed"), [(3, 1), (9, 2), (9, 8)])
def test_the_other_environments_keep_every_bit(pads, environments, changed):
    simulators = [held(pads, environments) for _ in range(2)]
    before = [results(simulators[1], k) for k in range(environments)]
    simulators[1].set_fingers(*pads_of(0.02), environments=[changed])
    others = [k for k in range(environments) if k != changed]
    for k in others:
        assert all(map(np.array_equal, results(simulators[1], k), before[k]))
    for simulator in simulators:
        simulator.advance(0.1, around(0.025, environments=environments))
    for k in others:
        assert all(map(np.array_equal, results(simulators[0], k), results(simulators[1], k)))
    forces = [simulator.contact().left[changed, 1] for simulator in simulators]
    assert forces[1] > 1.3 * forces[0]


def test_a_swap_in_one_equals_fingers_given_from_the_start(pads):
    wide = pads_of(0.02)
    mixed = [pads, pads, wide, pads]
    at_once = held(mixed, 4)
    swapped = Simulator(SMALL, pads, 4)
    swapped.reset(Material(), fingers=around(0.034, environments=4))
    swapped.set_fingers(*wide, environments=[2])
    swapped.advance(0.1, around(0.027, environments=4))
    assert np.array_equal(at_once.positions, swapped.positions)


def test_fingers_can_be_taken_away_from_one(pads):
    simulator = held(pads, 2)
    simulator.set_fingers(None, None, environments=[0])
    simulator.advance(0.1, around(0.025, environments=2))
    contact = simulator.contact()
    assert not contact.left[0].any()
    assert contact.left[1, 1] > 0.5
    assert contact.finger_penetration[0] == 0


def test_many_shapes_in_turn(pads):
    simulator = Simulator(SMALL, pads, 2)
    for half in np.linspace(0.005, 0.02, 12):  # the pool of grids fills up and is laid out anew
        simulator.set_fingers(*pads_of(half), environments=[1])
    simulator.set_fingers(*pads, environments=[1])
    simulator.reset(Material(), fingers=around(0.034, environments=2))
    simulator.advance(0.1, around(0.026, environments=2))
    assert np.array_equal(*simulator.positions)
    assert simulator._scene.grids.size < 2_000_000


def test_a_mesh_that_cannot_be_baked_leaves_everything_as_it_was(pads):
    simulator = held(pads, 2)
    expected = held(pads, 2)
    huge = SurfaceMesh.box((0, 0, 0), (20, 20, 50))
    with pytest.raises(ValueError, match="is the mesh in metres"):
        simulator.set_fingers([scoop(0.006), huge], [pads[1], huge], environments=[1, 0])
    assert not simulator.closing_limits.any()
    for one in (simulator, expected):
        one.advance(0.05, around(0.025, environments=2))
    assert np.array_equal(simulator.positions, expected.positions)


def test_environments_are_checked(pads):
    simulator = Simulator(SMALL, pads, 2)
    with pytest.raises(ValueError, match="2"):
        simulator.set_fingers(*pads, environments=[2])
    with pytest.raises(ValueError, match="one for each of the 1 environments"):
        simulator.set_fingers([pads[0]] * 2, pads[1], environments=[1])


@pytest.mark.parametrize(("thickness", "thin"), [(0.3e-3, True), (2.4e-3, True), (2.6e-3, False)])
def test_walls_too_thin_for_contact_are_told(thickness, thin):
    blade = SurfaceMesh.box((-0.01, 0.0, -0.02), (0.01, thickness, 0.02))
    mirrored = SurfaceMesh.box((-0.01, -thickness, -0.02), (0.01, 0.0, 0.02))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Simulator(SMALL, (blade, mirrored))
    messages = [str(w.message) for w in caught]
    assert len(messages) == (2 if thin else 0)
    if thin:
        assert f"thinnest {thickness * 1e3:.2f} mm" in messages[0]
        area = float(messages[0].removeprefix("left finger has ").split()[0])
        assert area == pytest.approx(1600, rel=0.01)
        assert messages[1].startswith("right finger has")


def test_the_sharp_edge_of_a_block_is_no_thin_wall(pads):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Simulator(SMALL, pads)
