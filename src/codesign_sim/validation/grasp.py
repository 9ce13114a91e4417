"""The reference grasp: a flat pad closes on the tofu, lifts it and holds it."""

from __future__ import annotations

import numpy as np

from codesign_sim.block import Block
from codesign_sim.fingers import FingerTargets
from codesign_sim.material import Material
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.simulator import Simulator
from codesign_sim.stress import StressMeasure
from codesign_sim.validation.check import Check

GRAVITY = 9.81
_OPEN = 0.034
_CENTRE = 0.026  # height of the grasp frame: the 50 mm pads clear the table by 1 mm
# Top-10 % and median von Mises stress in Pa of this grasp at 26 mm, by number of tetrahedra,
# from an independent implementation of the same model (which an implicit solver met to 1 %).
_PUBLISHED = {600: (1323, 715), 2400: (1367, 644), 8100: (1415, 574)}


class Grasp:
    """Flat pads 20 mm wide and 50 mm tall around blocks in as many environments as widths."""

    def __init__(self, block: Block, widths: np.ndarray, material: Material) -> None:
        pads = (
            SurfaceMesh.box((-0.01, 0.0, -0.025), (0.01, 0.01, 0.025)),
            SurfaceMesh.box((-0.01, -0.01, -0.025), (0.01, 0.0, 0.025)),
        )
        self.widths = np.asarray(widths, dtype=float)
        self.simulator = Simulator(block, pads, environments=len(self.widths))
        self.height = _CENTRE
        self.simulator.reset(material, fingers=self._at(np.full(len(self.widths), _OPEN)))

    def close(self) -> None:
        """Closes in half a second and waits a tenth."""
        self.simulator.advance(0.5, self._at(self.widths))
        self.simulator.advance(0.1)

    def lift(self, height: float, speed: float) -> None:
        """Raises the fingers at constant speed."""
        self.height += height
        self.simulator.advance(height / speed, self._at(self.widths))

    def hold(self, duration: float) -> None:
        """Keeps the fingers where they are."""
        self.simulator.advance(duration)

    def normal_force(self) -> np.ndarray:
        """Mean of both fingers' normal force (E,) over the last motion, N (left is at -y)."""
        contact = self.simulator.contact()
        return (contact.left[:, 1] - contact.right[:, 1]) / 2

    def held(self) -> np.ndarray:
        """Whether the table no longer carries anything and the block rose with the fingers."""
        centre = self.simulator.object_pose()[0][:, 2]
        rise = self.height - _CENTRE
        return centre - self.simulator.block.size[2] / 2 > 0.7 * rise

    def _at(self, width: np.ndarray) -> FingerTargets:
        place = np.tile([0.0, 0.0, self.height], (len(self.widths), 1))
        return FingerTargets.from_above(place, width)


def _reference(tets: int) -> Grasp:
    grasp = Grasp(Block.tofu(tets), np.array([0.026]), Material())
    grasp.close()
    grasp.lift(height=0.1, speed=0.1)
    grasp.hold(0.8)
    grasp.hold(0.2)  # what is averaged: four periods of the vibration that the stop leaves
    return grasp


def reference() -> list[Check]:
    """Closed to 26 mm at mu 0.5, lifted by 100 mm, held 1 s, 2,400 tetrahedra.

    Published 1367 and 644 Pa are the co-rotated measure; 5 % covers finger mesh and mass lumping.
    True Cauchy stress is 7-12 % lower. The force the fingers carry is the weight, to 2 % (the
    vibration that the lift's abrupt stop leaves). No side grasp can have a lower mean stress than
    rho g d / 2 mu, nor a lower normal force than m g / 2 mu.
    """
    grasp = _reference(2400)
    simulator, material = grasp.simulator, Material()
    stress = simulator.stress(StressMeasure.COROTATED)
    cauchy = simulator.stress(StressMeasure.CAUCHY)
    contact = simulator.contact()
    weight = material.density * simulator.block.volume * GRAVITY
    carried = contact.left[0, 2] + contact.right[0, 2]
    top, median = _PUBLISHED[2400]
    share = cauchy.top10_mean[0] / stress.top10_mean[0]
    least = material.density * GRAVITY * simulator.block.size[1] / (2 * material.friction)
    normal, normal_least = grasp.normal_force()[0], weight / (2 * material.friction)
    return [
        Check("grasp, held", 1, int(grasp.held()[0]), 0, ""),
        Check("grasp, top-10 % stress", top, stress.top10_mean[0], 0.05 * top, "Pa"),
        Check("grasp, median stress", median, stress.median[0], 0.05 * median, "Pa"),
        Check("grasp, Cauchy over co-rotated top-10 %", 0.905, share, 0.025, ""),
        Check("grasp, force carried", weight, carried, 0.02 * weight, "N"),
        Check("grasp, mean stress above the bound", least, stress.mean[0], 0.0, "Pa", True),
        Check("grasp, normal force above the bound", normal_least, normal, 0.0, "N", True),
    ]


def refinement() -> list[Check]:
    """The same grasp at 600, 2,400 and 8,100 tetrahedra.

    The top-10 % mean settles, the median still falls; both are compared with the published
    figures, to 5 %.
    """
    checks = []
    for tets, published in _PUBLISHED.items():
        stress = _reference(tets).simulator.stress()
        for name, expected, measured in zip(
            ("top-10 %", "median"), published, (stress.top10_mean[0], stress.median[0]), strict=True
        ):
            label = f"refinement, {name} stress at {tets} tetrahedra"
            checks.append(Check(label, expected, measured, 0.05 * expected, "Pa"))
    return checks
