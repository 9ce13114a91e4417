"""The scenario in this simulator."""

from __future__ import annotations

import time

import numpy as np

from codesign_sim.bench.cases import Case, Pass
from codesign_sim.bench.scenario import CLOSE, CONTROL_PERIOD, LIFT, STEPS, Fingers, pose
from codesign_sim.block import Block
from codesign_sim.fingers import FingerTargets
from codesign_sim.material import Material
from codesign_sim.simulator import Simulator


class CodesignGrasp:
    """Closes, lifts and holds, with the stress of every environment after every control step."""

    def __init__(self, case: Case, fingers: Fingers) -> None:
        self._fingers, self._envs = fingers, case.envs
        self._simulator = Simulator(Block.tofu(case.tets), fingers, case.envs, device=case.device)
        # The first motion and stress compile and allocate what later ones reuse.
        self._start()
        self._step(1)

    def run(self) -> Pass:
        """One grasp, timed after the reset."""
        self._start()
        rises = {}
        wall, cpu = time.perf_counter(), time.process_time()
        for step in range(1, STEPS + 1):
            self._step(step)
            if step in (CLOSE + LIFT, STEPS):
                rises[step] = self._rise()
        return Pass(
            control_steps=STEPS * self._envs,
            wall=time.perf_counter() - wall,
            cpu=time.process_time() - cpu,
            time_step=self._simulator.time_step,
            rise=(rises[CLOSE + LIFT], rises[STEPS]),
        )

    def _start(self) -> None:
        self._simulator.reset(Material(), fingers=self._targets(0))

    def _step(self, step: int) -> None:
        self._simulator.advance(CONTROL_PERIOD, self._targets(step))
        self._simulator.stress()

    def _targets(self, step: int) -> FingerTargets:
        now = pose(self._fingers, step)
        return FingerTargets.from_above(np.tile([0.0, 0.0, now.height], (self._envs, 1)), now.width)

    def _rise(self) -> float:
        height = self._simulator.object_pose()[0][:, 2] - self._simulator.block.size[2] / 2
        return float(height.mean())
