"""Free motion: rigid rotations, conserved momenta and energy, and violent fingers."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from codesign_sim.block import Block
from codesign_sim.checks import SimulationError
from codesign_sim.fingers import FingerTargets
from codesign_sim.material import Material
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.simulator import Simulator
from codesign_sim.validation.check import Check

_AXIS = np.array([1.0, 2.0, -2.0]) / 3


def static_rotation() -> list[Check]:
    """A rest shape turned by 131 degrees carries no stress.

    Coordinates of 0.03 m rounded to 2^-24 give edge strains of 4e-7, times E = 9 kPa and a few
    edges per element: 0.02 Pa.
    """
    simulator = _floating()
    turned = Rotation.from_rotvec(np.radians(131) * _AXIS).apply(simulator.rest_positions)
    simulator.set_state(turned[None], np.zeros_like(turned)[None])
    highest = simulator.stress().von_mises.max()
    return [Check("rotation 131 deg, highest stress", 0.0, highest, 0.02, "Pa")]


def spin() -> list[Check]:
    """A block spun at 9.1 rad/s for 2 s keeps its momenta, with both dampings on.

    Internal forces and dampings have no resultant; what may drift is rounding, about sqrt(steps)
    of 6e-8 for the linear and, since the warped shape vibrates at first, 1e-3 for the angular
    momentum.
    """
    simulator = _floating()
    rest = simulator.rest_positions
    drift = np.array([0.02, -0.01, 0.015])
    speed = np.cross(9.1 * _AXIS, rest) + drift
    simulator.set_state(rest[None], speed[None])
    before = _momenta(simulator)
    simulator.advance(2.0)
    after = _momenta(simulator)
    linear, angular = (
        float(np.linalg.norm(b - a) / np.linalg.norm(b)) for a, b in zip(after, before, strict=True)
    )
    return [
        Check("spin, change of linear momentum", 0.0, linear, 1e-5, ""),
        Check("spin, change of angular momentum", 0.0, angular, 1e-3, ""),
    ]


def energy() -> list[Check]:
    """An undamped block stretched by 10 % and sheared vibrates for 2 s at bounded energy.

    Symplectic Euler's energy oscillates by about w dt / 2 of each vibration (a few per cent for
    the ones excited here, w dt < 0.1) but must not grow: the means of the first and the last
    quarter agree to 1 %.
    """
    simulator = _floating(stiffness_damping=0.0, mass_damping=0.0, time_step=4e-4)
    rest = simulator.rest_positions
    stretch = np.array([[0.97, 0.05, 0.0], [0.0, 1.1, 0.0], [0.0, 0.03, 0.97]])
    simulator.set_state((rest @ stretch.T)[None], np.zeros_like(rest)[None])
    energies = [_energy(simulator)]
    for _ in range(200):
        simulator.advance(0.01)
        energies.append(_energy(simulator))
    ratio = np.array(energies) / energies[0]
    farthest = ratio[np.argmax(np.abs(ratio - 1))]
    growth = ratio[-50:].mean() / ratio[:50].mean()
    return [
        Check("energy, farthest from the first", 1.0, farthest, 0.05, ""),
        Check("energy, last quarter over first quarter", 1.0, growth, 0.01, ""),
    ]


def violent_actions() -> list[Check]:
    """Fingers jumping about, through the block and the table: the state stays finite.

    Eight environments, 200 motions of 50 ms each. Nodes never exceed the speed limit.
    """
    count = 8
    fingers = (
        SurfaceMesh.box((-0.01, 0.0, -0.025), (0.01, 0.01, 0.025)),
        SurfaceMesh.box((-0.01, -0.01, -0.025), (0.01, 0.0, 0.025)),
    )
    rng = np.random.default_rng(7)
    simulator = Simulator(Block.tofu(600), fingers, environments=count)
    materials = [
        Material(rng.uniform(8e3, 10e3), rng.uniform(0.3, 0.34), friction=rng.uniform(0.2, 1.0))
        for _ in range(count)
    ]
    position, width = np.tile([0.0, 0.0, 0.03], (count, 1)), np.full(count, 0.05)
    simulator.reset(materials, fingers=FingerTargets.from_above(position, width))
    broken, fastest = 0, 0.0
    for motion in range(200):
        if motion % 25 == 0:  # a thrown block is put back
            simulator.reset(materials, fingers=FingerTargets.from_above(position, width))
        position = np.clip(
            position + rng.uniform(-0.03, 0.03, (count, 3)), [-0.03, -0.03, 0], [0.03, 0.03, 0.06]
        )
        width = np.clip(width + rng.uniform(-0.04, 0.03, count), 0.0, 0.06)
        try:
            simulator.advance(0.05, FingerTargets.from_above(position, width))
        except SimulationError:
            broken += 1
            simulator.reset(materials, fingers=FingerTargets.from_above(position, width))
        finite = np.isfinite(simulator.positions).all() and np.isfinite(simulator.velocities).all()
        broken += not finite
        fastest = max(fastest, float(np.linalg.norm(simulator.velocities, axis=2).max()))
    headroom = simulator.top_speed - fastest
    return [
        Check("violent actions, states not finite", 0, broken, 0, ""),
        Check("violent actions, room below the speed limit", 0, headroom, 1e-3, "m/s", True),
    ]


def _floating(**options: Any) -> Simulator:
    simulator = Simulator(Block.tofu(2400), table_height=None, gravity=(0, 0, 0), **options)
    simulator.reset(Material())
    return simulator


def _momenta(simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular momentum (about the centre of mass) per unit density."""
    mass = simulator.block.node_volumes[:, None]
    x, v = simulator.positions[0], simulator.velocities[0]
    centre = (mass * x).sum(axis=0) / mass.sum()
    return (mass * v).sum(axis=0), np.cross(x - centre, mass * v).sum(axis=0)


def _energy(simulator: Simulator) -> float:
    """Kinetic and co-rotated elastic energy in J, in double precision."""
    block, material = simulator.block, Material()
    mu, lam = material.lame
    mass = material.density * block.node_volumes[:, None]
    kinetic = 0.5 * (mass * simulator.velocities[0] ** 2).sum()
    x = simulator.positions[0][block.tetrahedra]
    edges = np.transpose(x[:, 1:] - x[:, :1], (0, 2, 1))
    strain = np.linalg.svd(edges @ block.inverse_edges, compute_uv=False) - 1
    density = mu * (strain**2).sum(axis=1) + lam / 2 * strain.sum(axis=1) ** 2
    return float(kinetic + (density * block.volumes).sum())
