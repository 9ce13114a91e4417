"""Material constants and the stability limit."""

import numpy as np
import pytest
from small_block import SMALL

from codesign_sim import Block, Material, Simulator
from codesign_sim.material import stable_time_step

NO_CONTACT = 0.0


def test_lame_constants():
    mu, lam = Material(young_modulus=9e3, poisson_ratio=0.3125).lame
    assert mu == pytest.approx(3428.5714)
    assert lam == pytest.approx(5714.2857)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"young_modulus": -1.0}, "Young's modulus is -1 Pa; it must be above 0"),
        ({"density": 0.0}, "density is 0 kg/m"),
        ({"poisson_ratio": 0.5}, "Poisson's ratio is 0.5; it must lie between -1 and 0.5"),
        ({"poisson_ratio": -1.0}, "Poisson's ratio is -1"),
        ({"poisson_ratio": float("nan")}, "Poisson's ratio contains nan"),
        ({"friction": -0.1}, "friction coefficient is -0.1; it must be at least 0"),
        ({"young_modulus": "soft"}, "Young's modulus must be numbers"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        Material(**arguments)


def test_limit_scales_with_the_speed_of_sound():
    slow = stable_time_step(SMALL, Material(young_modulus=5e3, density=1000), NO_CONTACT, 0)
    fast = stable_time_step(SMALL, Material(young_modulus=20e3, density=1000), NO_CONTACT, 0)
    assert slow == pytest.approx(2 * fast, rel=1e-3)


def test_limit_scales_with_the_mesh():
    coarse = Block((0.03, 0.03, 0.03), (2, 2, 2))
    fine = Block((0.03, 0.03, 0.03), (4, 4, 4))
    ratio = stable_time_step(coarse, Material(), NO_CONTACT, 0) / stable_time_step(
        fine, Material(), NO_CONTACT, 0
    )
    assert 1.7 < ratio < 2.3


def test_contact_and_damping_shorten_the_limit():
    free = stable_time_step(SMALL, Material(), NO_CONTACT, 0)
    contact = stable_time_step(SMALL, Material(), 9e6, 0)
    damped = stable_time_step(SMALL, Material(), 9e6, 2e-4)
    assert damped < contact < free


@pytest.mark.parametrize("beta", [0.0, 2e-4])
@pytest.mark.parametrize(("share", "grows"), [(0.97, False), (1.05, True)])
def test_limit_is_where_vibrations_start_to_grow(beta, share, grows):
    simulator = Simulator(
        SMALL,
        table_height=None,
        gravity=(0, 0, 0),
        stiffness_damping=beta,
        mass_damping=0,
        contact_stiffness=1.0,
    )
    simulator.reset(Material())
    rng = np.random.default_rng(3)
    shape = (1, len(SMALL.nodes), 3)
    simulator.set_state(simulator.positions, 1e-4 * rng.standard_normal(shape))
    start = np.abs(simulator.velocities).max()
    step = share * stable_time_step(SMALL, Material(), NO_CONTACT, beta)
    simulator.time_step = step
    simulator.advance(400 * step)
    end = np.abs(simulator.velocities).max()
    assert (end > 100 * start) == grows
    assert grows or end < 3 * start
