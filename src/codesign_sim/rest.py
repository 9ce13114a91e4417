"""Shapes of blocks at rest on the table, computed once and reused at every reset."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import product

import numpy as np

from codesign_sim.material import Material
from codesign_sim.simulator import Simulator
from codesign_sim.soft_object import SoftObject

Range = tuple[float, float]
_ROUNDING = 1e-9


@lru_cache(maxsize=64)
def rest_shape(block: SoftObject, material: Material) -> np.ndarray:
    """The block settled under its own weight, (N, 3) m, base centre at the origin.

    Simulated alone, with the simulator's default settings. The array is shared and read-only.
    """
    simulator = Simulator(block)
    simulator.reset(material)
    shape = simulator.positions[0]
    shape.setflags(write=False)
    return shape


class RestShapes:
    """Rest shapes of every material within a box, interpolated between its corners.

    Linear in 1 / E, to which the sag is proportional, in Poisson's ratio and in friction: for the
    paper's tofu right to 1 um at fixed friction, to 30 um over friction 0.3-0.8. A side of the
    box that has no length costs nothing.

    The springs of friction start unstretched from these shapes. The base then spreads by up to
    25 um, at 0.7 mm/s at first, and the resting stress ends 1 % higher than after `settle`.

    Args:
        block: shape and mesh.
        young_modulus: (lowest, highest) in Pa.
        poisson_ratio: (lowest, highest).
        friction: (lowest, highest), Coulomb coefficient.
        density: kg/m^3, one for all.
    """

    def __init__(
        self,
        block: SoftObject,
        young_modulus: Range,
        poisson_ratio: Range,
        friction: Range,
        density: float,
    ) -> None:
        sides = [(1 / young_modulus[1], 1 / young_modulus[0]), poisson_ratio, friction]
        self._low = np.array([low for low, _ in sides])
        self._length = np.array([high - low for low, high in sides])
        self._density = density
        corners = product(*((0,) if length == 0 else (0, 1) for length in self._length))
        self._shapes = {corner: self._settled(block, corner) for corner in corners}

    def of(self, materials: Sequence[Material]) -> np.ndarray:
        """Rest shapes (K, N, 3) in metres.

        Raises:
            ValueError: a material outside the box.
        """
        return np.stack([self._interpolated(material) for material in materials])

    def _settled(self, block: SoftObject, corner: tuple[int, ...]) -> np.ndarray:
        compliance, poisson_ratio, friction = self._low + np.array(corner) * self._length
        return rest_shape(block, Material(1 / compliance, poisson_ratio, self._density, friction))

    def _interpolated(self, material: Material) -> np.ndarray:
        here = np.array([1 / material.young_modulus, material.poisson_ratio, material.friction])
        along = (here - self._low) / np.where(self._length == 0, 1, self._length)
        farthest = np.where(self._length == 0, 0.0, 1.0) + _ROUNDING
        if ((along < -_ROUNDING) | (along > farthest)).any() or material.density != self._density:
            raise ValueError(f"{material} is outside the box that rest shapes were computed for")
        return np.sum(
            [
                float(np.prod(np.where(corner, along, 1 - along))) * shape
                for corner, shape in self._shapes.items()
            ],
            axis=0,
        )
