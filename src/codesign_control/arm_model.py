"""Stand-in for a real arm: follows joint commands with a lag. Deterministic."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from codesign_control.motion import DOF
from codesign_control.pose import finite_vector
from codesign_control.xarm7 import Xarm7


@dataclass(frozen=True)
class ArmModelConfig:
    """How closely the arm follows. Raises ValueError for values that make no sense."""

    order: int = 1  # 1: exponential lag; 2: two equal lags in series (critically damped)
    time_constant: float = 0.01  # s, of each lag
    velocity_limit: float = 3.14  # rad/s, xArm7 URDF

    def __post_init__(self) -> None:
        if self.order not in (1, 2):
            raise ValueError(f"order: {self.order}, expected 1 or 2")
        if not (math.isfinite(self.time_constant) and self.time_constant > 0):
            raise ValueError(f"time_constant: {self.time_constant} s, expected more than 0")
        if not self.velocity_limit > 0:
            raise ValueError(f"velocity_limit: {self.velocity_limit} rad/s, expected more than 0")


class ArmModel:
    """Joint positions and velocities of an arm that follows commands.

    position: (7,) rad. velocity: (7,) rad/s, mean over the last step.
    """

    def __init__(
        self,
        arm: Xarm7,
        config: ArmModelConfig | None = None,
        position: np.ndarray | None = None,
    ) -> None:
        self._arm = arm
        self.config = config or ArmModelConfig()
        self.reset(arm.home if position is None else position)

    def reset(self, position: np.ndarray) -> None:
        """Stands at `position`; ValueError when that is not a finite (7,) vector."""
        self.position = finite_vector("position", position, DOF)
        self.velocity = np.zeros(DOF)
        self._lagged = self.position.copy()  # output of the first of two lags

    def step(self, command: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Follows a (7,) position command for dt s; returns copies of position and velocity.

        The command is held over the step. Joint limits stop the arm as its hard stops would.
        Raises ValueError for a command or dt that is not finite, as a driver has to.
        """
        command = finite_vector("command", command, DOF)
        if not (math.isfinite(dt) and dt > 0):
            raise ValueError(f"dt: {dt} s, expected more than 0")
        ratio = dt / self.config.time_constant
        decay = math.exp(-ratio)
        gap = command - self.position
        if self.config.order == 1:
            wanted = command - decay * gap
        else:  # two equal lags in series, solved exactly for a held command
            wanted = command - decay * (gap + ratio * (command - self._lagged))
            self._lagged = command - decay * (command - self._lagged)
        most = self.config.velocity_limit * dt
        moved = self.position + np.clip(wanted - self.position, -most, most)
        moved = np.clip(moved, self._arm.lower, self._arm.upper)
        self.velocity = (moved - self.position) / dt
        self.position = moved
        return self.position.copy(), self.velocity.copy()
