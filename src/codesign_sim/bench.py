"""How fast the simulator is: control steps per second of the reference grasp."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from codesign_sim.block import Block
from codesign_sim.fingers import FingerTargets
from codesign_sim.material import Material
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.simulator import Simulator

CONTROL_PERIOD = 0.05  # s, the paper's 20 Hz
CLOSE, LIFT = 10, 20  # control steps


@dataclass(frozen=True)
class Rate:
    """Measured rate; a control step is one environment advanced by 0.05 s, stress included."""

    tets: int
    environments: int
    time_step: float
    control_steps_per_second: float
    control_steps_per_cpu_second: float
    single_core_real_time_factor: float


def measure(tets: int, environments: int, seconds: float = 3.0) -> Rate:
    """Repeats closing and lifting, in contact throughout, for about `seconds` of wall time."""
    pads = (
        SurfaceMesh.box((-0.01, 0.0, -0.025), (0.01, 0.01, 0.025)),
        SurfaceMesh.box((-0.01, -0.01, -0.025), (0.01, 0.0, 0.025)),
    )
    simulator = Simulator(Block.tofu(tets), pads, environments)
    steps = 0
    wall = cpu = 0.0
    while wall < seconds:
        simulator.reset(Material(), fingers=_targets(environments, 0))
        wall_start, cpu_start = time.perf_counter(), time.process_time()
        for step in range(CLOSE + LIFT):
            simulator.advance(CONTROL_PERIOD, _targets(environments, step + 1))
            simulator.stress()
        wall += time.perf_counter() - wall_start
        cpu += time.process_time() - cpu_start
        steps += (CLOSE + LIFT) * environments
    return Rate(
        tets=tets,
        environments=environments,
        time_step=simulator.time_step,
        control_steps_per_second=steps / wall,
        control_steps_per_cpu_second=steps / cpu,
        single_core_real_time_factor=steps * CONTROL_PERIOD / cpu,
    )


def _targets(environments: int, step: int) -> FingerTargets:
    width = 0.031 - 0.005 * min(step / CLOSE, 1.0)
    height = 0.026 + 0.1 * max(step - CLOSE, 0) / LIFT
    return FingerTargets.from_above(np.tile([0.0, 0.0, height], (environments, 1)), width)
