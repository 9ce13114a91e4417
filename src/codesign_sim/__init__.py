"""Soft-body simulation of a grasp: block, fingers, contact and stress, in NVIDIA Warp."""

from codesign_sim.block import Block
from codesign_sim.checks import SimulationError
from codesign_sim.closing import closing_limit
from codesign_sim.fingers import FingerTargets
from codesign_sim.material import Material
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.simulator import ContactForces, Simulator
from codesign_sim.soft_object import SoftObject
from codesign_sim.stress import Stress, StressMeasure
from codesign_sim.tet_mesh import TetrahedralMesh
from codesign_sim.warm_up import warm_up

__all__ = [
    "Block",
    "ContactForces",
    "FingerTargets",
    "Material",
    "SimulationError",
    "Simulator",
    "SoftObject",
    "Stress",
    "StressMeasure",
    "SurfaceMesh",
    "TetrahedralMesh",
    "closing_limit",
    "warm_up",
]
