"""Cantilevers: small deflections against Timoshenko's beam, large ones against the elastica."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from codesign_sim.block import Block
from codesign_sim.material import Material
from codesign_sim.simulator import Simulator
from codesign_sim.validation.check import Check

_LENGTH, _HEIGHT = 0.08, 0.01
_MATERIAL = Material()
_STIFFNESS = _MATERIAL.young_modulus * _HEIGHT**4 / 12  # E I
_SHEAR = 5 / 6 * _MATERIAL.lame[0] * _HEIGHT**2  # kappa G A
# First bending frequency in rad/s; damping at twice it brings the tip to rest soonest.
_FREQUENCY = 3.516 / _LENGTH**2 * np.sqrt(_STIFFNESS / (_MATERIAL.density * _HEIGHT**2))


def small_deflection() -> list[Check]:
    """Tip load for a deflection of 0.5 % of the length, with 2, 4 and 8 cells over the height.

    Expected P L^3 / 3 E I + P L / kappa G A (Timoshenko). Constant-strain tetrahedra are too
    stiff in bending by a share of order h^2: the 8-cell beam must be within 5 %, each halving
    must take away more than 55 % of the error, and the extrapolation to h = 0 must be within 3 %
    (the clamp also holds the section's width, which the beam theory leaves free).
    """
    ratios = {cells: _tip_deflection(cells, 0.005) for cells in (2, 4, 8)}
    extrapolated = ratios[8] + (ratios[8] - ratios[4]) / 3
    checks = [Check("cantilever, 8 cells over Timoshenko", 1.0, ratios[8], 0.05, "")]
    for coarse, fine in ((2, 4), (4, 8)):
        gain = (1 - ratios[coarse]) / (1 - ratios[fine])
        name = f"cantilever, error at {coarse} over {fine} cells"
        checks.append(Check(name, 1 / 0.45, gain, 0.0, "", at_least=True))
    checks.append(Check("cantilever, extrapolated to h = 0", 1.0, extrapolated, 0.03, ""))
    return checks


def large_deflection() -> list[Check]:
    """Tip load P L^2 / E I = 2, the tip falls by half the length: against Euler's elastica.

    The mesh's own bending stiffness, measured at a small load, takes the place of E I, so that
    what is compared is the geometry: 2 % covers shear and stretch, of order (h / L)^2.
    """
    cells = 4
    softness = _tip_deflection(cells, 0.005) * (1 + 3 * _STIFFNESS / (_SHEAR * _LENGTH**2))
    load = 2 * (_STIFFNESS / softness) / _LENGTH**2
    tip = _tip_displacement(cells, load)
    down, along = elastica(2.0)
    return [
        Check("elastica, tip deflection / length", down, -tip[2] / _LENGTH, 0.02 * down, ""),
        Check("elastica, tip shortening / length", along, -tip[0] / _LENGTH, 0.05 * along, ""),
    ]


def elastica(load: float) -> tuple[float, float]:
    """Tip deflection and shortening over length of a cantilever under P L^2 / E I = `load`.

    Solves theta'' = -load cos(theta), theta(0) = 0, theta'(1) = 0 by shooting.
    """

    def shoot(curvature: float) -> np.ndarray:
        def slope(_: float, y: np.ndarray) -> list[float]:
            return [y[1], -load * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]

        solution = solve_ivp(slope, (0, 1), [0.0, curvature, 0.0, 0.0], rtol=1e-9, atol=1e-11)
        return solution.y[:, -1]

    end = shoot(brentq(lambda c: shoot(c)[1], 0.0, load))
    return float(end[3]), float(1 - end[2])


def _tip_deflection(cells: int, share: float) -> float:
    """Measured over Timoshenko's deflection, at the load that should bend by share * length."""
    per_load = _LENGTH**3 / (3 * _STIFFNESS) + _LENGTH / _SHEAR
    load = share * _LENGTH / per_load
    return float(-_tip_displacement(cells, load)[2] / (share * _LENGTH))


def _tip_displacement(cells: int, load: float) -> np.ndarray:
    """Mean displacement (3,) of the loaded end of a beam pinned at the other, metres."""
    count = (round(_LENGTH / _HEIGHT) * cells, cells, cells)
    block = Block((_LENGTH, _HEIGHT, _HEIGHT), count)
    simulator = Simulator(block, table_height=None, gravity=(0, 0, 0))
    simulator.reset(_MATERIAL)
    start = simulator.positions[0]
    left = np.flatnonzero(block.nodes[:, 0] < -_LENGTH / 2 + 1e-9)
    right = np.flatnonzero(block.nodes[:, 0] > _LENGTH / 2 - 1e-9)
    simulator.pin(left)
    forces = np.zeros_like(start)
    forces[right, 2] = -load * block.node_volumes[right] / block.node_volumes[right].sum()
    simulator.set_loads(forces)
    simulator.settle(duration=8 / _FREQUENCY, damping=2 * _FREQUENCY)
    return (simulator.positions[0] - start)[right].mean(axis=0)
