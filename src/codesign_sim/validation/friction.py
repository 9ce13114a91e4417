"""Coulomb friction: an incline, and the force that just holds the block."""

from __future__ import annotations

import numpy as np

from codesign_sim.block import Block
from codesign_sim.material import Material
from codesign_sim.simulator import Simulator
from codesign_sim.validation.check import Check
from codesign_sim.validation.grasp import GRAVITY, Grasp

_ANGLE = np.radians(20)


def incline() -> list[Check]:
    """On 20 degrees the block sticks iff mu > tan 20 = 0.364, and else slides at its rate.

    Sixteen frictions, 0.002 apart, bracket the threshold; half a step and the pressure's uneven
    share (the upper edge carries less and gives way first) allow 0.004. The acceleration
    g (sin - mu cos) is measured between 0.1 and 0.3 s, to 1 %.
    """
    frictions = np.linspace(0.35, 0.38, 16)
    gravity = (GRAVITY * np.sin(_ANGLE), 0.0, -GRAVITY * np.cos(_ANGLE))
    simulator = Simulator(Block.tofu(600), environments=17, gravity=gravity)
    simulator.reset([Material(friction=mu) for mu in [*frictions, 0.2]])
    simulator.advance(0.1)
    early = _speed(simulator)
    simulator.advance(0.2)
    late = _speed(simulator)
    simulator.advance(0.7)
    # One step of mu below the threshold gains 18 mm/s in a second; a sticking block has none.
    sticks = _speed(simulator)[:16] < 1e-3
    threshold = _switch(frictions, sticks)
    expected = GRAVITY * (np.sin(_ANGLE) - 0.2 * np.cos(_ANGLE))
    measured = (late[16] - early[16]) / 0.2
    return [
        Check("incline, friction that holds", np.tan(_ANGLE), threshold, 0.004, ""),
        Check("incline, acceleration at mu 0.2", expected, measured, 0.01 * expected, "m/s^2"),
    ]


def hold_threshold() -> list[Check]:
    """The lifted block drops iff the normal force is below m g / 2 mu.

    Eight closing widths about the critical one; a slow lift (2 mm/s, so that its start adds 2 %
    of the weight) by 4 mm, after which the fingers either carry everything or slip. Compared is
    the smallest force that holds: the step between widths is 2 %, and 2 % of the normal force
    acts on the pads' rounded edges and not along the opening, hence 4 %.
    """
    block = Block.tofu(2400)
    checks = []
    for mu, widths in ((0.3, (26.3, 26.65)), (0.5, (27.6, 27.95)), (0.8, (28.55, 28.8))):
        grasp = Grasp(block, np.linspace(*widths, 8) * 1e-3, Material(friction=mu))
        grasp.close()
        grasp.lift(height=0.004, speed=0.002)
        grasp.hold(0.2)
        weight = GRAVITY * Material().density * block.volume
        held = grasp.simulator.contact().table[:, 2] < 0.01 * weight
        force = grasp.normal_force()
        # Both must occur, and every force that holds be above every one that does not.
        clean = held.any() and not held.all() and force[held].min() > force[~held].max()
        least = force[held].min() if clean else np.nan
        expected = weight / (2 * mu)
        checks.append(
            Check(f"hold, smallest normal force at mu {mu}", expected, least, 0.04 * expected, "N")
        )
    return checks


def _speed(simulator: Simulator) -> np.ndarray:
    weights = simulator.block.node_volumes / simulator.block.volume
    return simulator.velocities[:, :, 0] @ weights


def _switch(values: np.ndarray, held: np.ndarray) -> float:
    """Middle between the last value that fails and the first that holds; nan if mixed."""
    order = np.argsort(values)
    held = held[order]
    first = int(np.argmax(held))
    clean = first > 0 and held[first:].all()
    return float(values[order][first - 1 : first + 1].mean()) if clean else float("nan")
