"""The scenario in MuJoCo's flex, with the fastest settings found.

Same tetrahedra, Young's modulus, Poisson's ratio, density and friction, every node free. The pads
are boxes of the fingers' faces, moved by joints of prescribed position and velocity (friction does
not see how mocap bodies move). Measured with MuJoCo 4.0 on 600 tetrahedra:

- Elasticity needs the `discrete` integrator; `Euler` would need steps as short as ours.
- CG takes a third to a half of Newton's time, sparse Jacobians half of dense ones'.
- Elliptic cones are as fast as pyramidal ones, and the block slips less.
- Contact at MuJoCo's default stiffness is softer than the tofu and never lifts it.
- Steps of 6.25 ms lift; at 10 ms CG no longer converges. At 2,400 tetrahedra no step of 1.25 to
  5 ms lifted the block; at 5 ms some solves end just above their tolerance (see the warnings).

MuJoCo has no stress of a soft body, so nothing is computed where this simulator computes stress.
"""

from __future__ import annotations

import time

import mujoco
import numpy as np

from codesign_sim.bench.cases import Case, Pass
from codesign_sim.bench.scenario import CLOSE, CONTROL_PERIOD, LIFT, STEPS, Fingers, pose
from codesign_sim.block import Block
from codesign_sim.material import Material
from codesign_sim.mesh import SurfaceMesh

_TIME_STEPS = {600: 0.00625, 2400: 0.005}  # s, by number of tetrahedra
_DAMPING = 2e-4  # s, as this simulator's stiffness damping
_RADIUS = 1e-4  # m, by which a flex is thicker than its nodes
_HALF_DEPTH = 0.005  # m, of a pad
_FACE = 1e-4  # m, vertices this close to the most protruding one make the face

_MODEL = """
<mujoco>
  <option timestep="{time_step}" integrator="discrete" solver="CG" cone="elliptic"
          jacobian="sparse" iterations="50" tolerance="1e-6" gravity="0 0 -9.81"/>
  <default>
    <geom condim="3" friction="{friction} 0 0" solref="-1e6 -2000"/>
  </default>
  <worldbody>
    <geom type="plane" size="1 1 0.1"/>
    {pads}
    <flexcomp name="tofu" type="direct" dim="3" mass="{mass}" radius="{radius}"
              pos="0 0 {height}" point="{points}" element="{elements}">
      <elasticity young="{young}" poisson="{poisson}" damping="{damping}"/>
      <contact condim="3" friction="{friction} 0 0" solref="-1e6 -2000" selfcollide="none"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""
_PAD = """
    <body gravcomp="1">
      <joint type="slide" axis="0 1 0"/>
      <joint type="slide" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="1000" diaginertia="1 1 1"/>
      <geom type="box" size="{size}" pos="{centre}"/>
    </body>
"""


class MujocoGrasp:
    """Closes, lifts and holds one block per environment, one after the other."""

    def __init__(self, case: Case, fingers: Fingers) -> None:
        self._fingers, self._block = fingers, Block.tofu(case.tets)
        self._time_step = _TIME_STEPS[case.tets]
        # They are counted; printed, they would also go to a file in the working directory.
        mujoco.set_mju_user_warning(lambda message: None)
        self._model = mujoco.MjModel.from_xml_string(self._xml())
        self._data = [mujoco.MjData(self._model) for _ in range(case.envs)]
        for data in self._data:
            self._place(data, 0.0)
            mujoco.mj_step(self._model, data)

    def run(self) -> Pass:
        """One grasp, timed after the reset."""
        for data in self._data:
            mujoco.mj_resetData(self._model, data)
            data.qpos[:4] = self._pads(0.0)
        substeps = round(CONTROL_PERIOD / self._time_step)
        rises = {}
        wall, cpu = time.perf_counter(), time.process_time()
        for step in range(STEPS):
            for data in self._data:
                for substep in range(substeps):
                    self._place(data, step + (substep + 1) / substeps)
                    mujoco.mj_step(self._model, data)
            if step + 1 in (CLOSE + LIFT, STEPS):
                rises[step + 1] = self._rise()
        return Pass(
            control_steps=STEPS * len(self._data),
            wall=time.perf_counter() - wall,
            cpu=time.process_time() - cpu,
            time_step=self._time_step,
            rise=(rises[CLOSE + LIFT], rises[STEPS]),
            warnings=sum(int(w.number) for data in self._data for w in data.warning),
        )

    def _place(self, data: mujoco.MjData, step: float) -> None:
        """Gives the pads the velocity that takes them to where they belong in one time step."""
        data.qvel[:4] = (self._pads(step) - data.qpos[:4]) / self._time_step

    def _pads(self, step: float) -> np.ndarray:
        now = pose(self._fingers, step)
        return np.array([now.width / 2, now.height, -now.width / 2, now.height])

    def _rise(self) -> float:
        heights = [data.flexvert_xpos[:, 2].mean() for data in self._data]
        return float(np.mean(heights)) - self._block.size[2] / 2

    def _xml(self) -> str:
        block, material = self._block, Material()
        return _MODEL.format(
            time_step=self._time_step,
            friction=material.friction,
            mass=material.density * block.volume,
            radius=_RADIUS,
            height=block.size[2] / 2 + _RADIUS,
            points=_numbers(block.nodes),
            elements=" ".join(map(str, block.tetrahedra.ravel())),
            young=material.young_modulus,
            poisson=material.poisson_ratio,
            damping=_DAMPING,
            pads="".join(_pad(mesh, side) for mesh, side in zip(self._fingers, (1, -1),
                                                                strict=True)),
        )  # fmt: skip


def _pad(mesh: SurfaceMesh, side: int) -> str:
    """A box behind the flat face of a finger, whose z axis points down."""
    inwards = mesh.vertices[:, 1] * side
    face = mesh.vertices[inwards < inwards.min() + _FACE]
    low, high = face.min(axis=0), face.max(axis=0)
    centre = np.array([0.0, side * _HALF_DEPTH, -(low[2] + high[2]) / 2])
    size = np.array([(high[0] - low[0]) / 2, _HALF_DEPTH, (high[2] - low[2]) / 2])
    return _PAD.format(size=_numbers(size), centre=_numbers(centre))


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values.ravel())
