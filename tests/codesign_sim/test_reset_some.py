"""Some environments start anew while the others go on."""

import numpy as np
import pytest
from small_block import SMALL, around

from codesign_sim import Material, SimulationError, Simulator
from codesign_sim.rest import RestShapes, rest_shape

COUNT = 9  # two groups of lanes, one nearly empty: spare lanes follow the last environment
STEP = 4e-4


def grasping(pads, count: int = COUNT) -> Simulator:
    materials = [Material(8e3 + 200 * k) for k in range(count)]
    simulator = Simulator(SMALL, pads, count, time_step=STEP)
    simulator.reset(materials, fingers=around(0.034, environments=count))
    simulator.advance(0.1, around(0.027, environments=count))
    return simulator


def state(simulator: Simulator, chosen) -> list[np.ndarray]:
    contact = simulator.contact()
    return [
        a[chosen] for a in (simulator.positions, simulator.velocities, contact.left, contact.table)
    ]


@pytest.mark.parametrize("chosen", [[0], [3, 8], list(range(1, 9))])
def test_the_others_keep_every_bit_and_go_on_as_if_nothing_had_happened(pads, chosen) -> None:
    others = np.setdiff1d(np.arange(COUNT), chosen)
    reset, untouched = grasping(pads), grasping(pads)
    before = state(reset, others)
    start = around(0.034, environments=len(chosen))
    reset.reset_some(chosen, Material(9.5e3), rest_shape(SMALL, Material(9.5e3)), fingers=start)
    for now, was in zip(state(reset, others), before, strict=True):
        assert np.array_equal(now, was)
    targets = around(0.026, environments=COUNT)
    for simulator in (reset, untouched):
        simulator.advance(0.05, targets)
    for one, other in zip(state(reset, others), state(untouched, others), strict=True):
        assert np.array_equal(one, other)
    assert not np.array_equal(reset.positions[chosen], untouched.positions[chosen])


def test_an_environment_reset_in_company_repeats_one_reset_alone(pads) -> None:
    material, place = Material(8.4e3, friction=0.6), (0.02, -0.01)
    shape = rest_shape(SMALL, material)
    ends = []
    for others in (0.027, 0.020):  # what the neighbours do
        simulator = grasping(pads)
        simulator.advance(0.1, around(others, environments=COUNT))
        start = around(0.036)
        simulator.reset_some([4], material, shape, place, yaw=0.3, fingers=start)
        widths = np.full(COUNT, others)
        widths[4] = 0.033
        simulator.advance(0.1, around(widths, environments=COUNT))
        widths[4] = 0.027
        simulator.advance(0.1, around(widths, environments=COUNT))
        ends.append([a[[4]] for a in (simulator.positions, simulator.velocities)])
        ends[-1] += [simulator.stress().von_mises[4], simulator.contact().left[4]]
    for one, other in zip(*ends, strict=True):
        assert np.array_equal(one, other)


def test_a_reset_block_rests_where_it_was_put(pads) -> None:
    simulator = grasping(pads)
    material = Material(9e3)
    shape = rest_shape(SMALL, material)
    far = around(0.06, environments=1)
    simulator.reset_some([2], material, shape, (0.1, 0.2), fingers=far)
    centre, _ = simulator.object_pose()
    weights = SMALL.node_volumes / SMALL.volume
    assert centre[2] == pytest.approx([0.1, 0.2, weights @ shape[:, 2]], abs=1e-6)
    assert np.abs(simulator.velocities[2]).max() == 0.0
    hold = simulator.fingers
    simulator.advance(0.5, hold)
    assert np.abs(simulator.positions[2] - shape - [0.1, 0.2, 0.0]).max() < 4e-5  # metres
    weight = material.density * SMALL.volume * 9.81
    assert simulator.contact().table[2, 2] == pytest.approx(weight, rel=1e-3)


def test_interpolated_shapes_are_those_of_the_material() -> None:
    shapes = RestShapes(SMALL, (8e3, 10e3), (0.3, 0.325), (0.5, 0.5), 1020.0)
    for material in (Material(8e3, 0.3), Material(9.1e3, 0.31), Material(10e3, 0.325)):
        exact = rest_shape(SMALL, material)
        assert np.abs(shapes.of([material])[0] - exact).max() < 1e-6  # metres
    with pytest.raises(ValueError, match="outside the box"):
        shapes.of([Material(11e3)])
    with pytest.raises(ValueError, match="outside the box"):
        shapes.of([Material(9e3, friction=0.6)])


def test_refuses_what_it_cannot_reset(pads) -> None:
    simulator = Simulator(SMALL, pads, 2)
    shape = rest_shape(SMALL, Material())
    with pytest.raises(SimulationError, match="not reset yet"):
        simulator.reset_some([0], Material(), shape)
    simulator.reset(fingers=around(0.034, environments=2))
    with pytest.raises(ValueError, match=r"\[0, 0\].*0 to 1"):
        simulator.reset_some([0, 0], Material(), shape, fingers=around(0.034, environments=2))
    with pytest.raises(ValueError, match=r"\[2\].*0 to 1"):
        simulator.reset_some([2], Material(), shape, fingers=around(0.034))
    with pytest.raises(ValueError, match="fingers are away in some"):
        simulator.reset_some([0], Material(), shape)
    with pytest.raises(ValueError, match="2 finger targets for 1"):
        simulator.reset_some([0], Material(), shape, fingers=around(0.03, environments=2))
