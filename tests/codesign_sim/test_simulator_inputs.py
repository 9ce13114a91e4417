"""Wrong arguments are refused with the value, the limit and the remedy."""

import numpy as np
import pytest
from small_block import SMALL, around

from codesign_sim import FingerTargets, Material, SimulationError, Simulator


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"environments": 0}, "environments is 0; use a whole number of at least 1"),
        ({"environments": 1.5}, "environments is 1.5"),
        ({"device": "tpu"}, "device is 'tpu'; use 'cpu' or 'cuda'"),
        ({"time_step": -1e-3}, "time step is -0.001 s; it must be above 0"),
        ({"gravity": (0, 0)}, r"gravity has shape \(2,\); it must be \(3,\)"),
        ({"table_height": np.nan}, "table height contains nan"),
        ({"stiffness_damping": -1.0}, "stiffness damping is -1 s; it must be at least 0"),
        ({"mass_damping": np.inf}, "mass damping contains inf"),
        ({"contact_stiffness": 0.0}, "contact stiffness is 0 Pa/m; it must be above 0"),
    ],
)
def test_constructor(arguments, message):
    with pytest.raises(ValueError, match=message):
        Simulator(SMALL, **arguments)


def test_too_long_a_time_step_names_the_limit():
    simulator = Simulator(SMALL, time_step=5e-3)
    with pytest.raises(ValueError, match=r"time step is 5 ms; the stability limit .* is \d.*ms"):
        simulator.reset(Material())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"materials": [Material()] * 3}, "got 3 materials for 2 environments"),
        ({"position": (np.nan, 0)}, "block position contains nan"),
        ({"position": (0, 0, 0)}, r"block position has shape \(3,\); it must be \(2, 2\)"),
        ({"yaw": [0.0] * 3}, r"yaw has shape \(3,\); it must be \(2,\)"),
        ({"fingers": around(0.034)}, "finger targets are for 1 environments; there are 2"),
    ],
)
def test_reset(pads, arguments, message):
    simulator = Simulator(SMALL, pads, environments=2)
    with pytest.raises(ValueError, match=message):
        simulator.reset(**arguments)


def test_nothing_works_before_a_reset(pads):
    simulator = Simulator(SMALL, pads)
    for call in (lambda: simulator.advance(0.01), simulator.stress, simulator.contact):
        with pytest.raises(SimulationError, match="call reset"):
            call()


def test_fast_fingers_name_the_speed_limit(pads):
    simulator = Simulator(SMALL, pads)
    simulator.reset(fingers=around(0.034))
    with pytest.raises(ValueError, match=r"mm per step .* the limit is 1 mm .* take longer"):
        simulator.advance(0.01, around(0.034, height=0.2))
    assert simulator.fingers.position[0, 2] == 0.026


def test_fast_turns_count_as_fast(pads):
    simulator = Simulator(SMALL, pads)
    simulator.reset(fingers=around(0.034))
    with pytest.raises(ValueError, match="mm per step"):
        simulator.advance(0.005, FingerTargets.from_above((0, 0, 0.026), 0.034, yaw=1.5))


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan])
def test_durations(floating, duration):
    with pytest.raises(ValueError, match="duration"):
        floating.advance(duration)


def test_targets_need_fingers(floating):
    with pytest.raises(ValueError, match="no fingers"):
        floating.advance(0.01, around(0.03))


def test_fingers_of_too_few_environments(pads):
    simulator = Simulator(SMALL, environments=3)
    with pytest.raises(ValueError, match="left finger: give one SurfaceMesh, or one for each of"):
        simulator.set_fingers([pads[0]] * 2, pads[1])


def test_states_and_loads(floating):
    with pytest.raises(ValueError, match="positions has shape"):
        floating.set_state(np.zeros((1, 4, 3)), np.zeros((1, 4, 3)))
    with pytest.raises(ValueError, match="loads contains nan"):
        floating.set_loads(np.full(floating.rest_positions.shape, np.nan))
