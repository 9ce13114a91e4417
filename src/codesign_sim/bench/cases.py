"""What is measured, and what came out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Case:
    """One configuration.

    Attributes:
        solver: "codesign" or "mujoco-flex".
        tets: tetrahedra of the tofu.
        envs: environments side by side in every process.
        processes: at the same time.
        device: "cpu" or "cuda".
    """

    solver: str
    tets: int
    envs: int
    processes: int
    device: str = "cpu"


@dataclass(frozen=True)
class Pass:
    """What one process measured in one repetition.

    Attributes:
        control_steps: taken by all its environments together.
        wall, cpu: seconds.
        time_step: of the solver, seconds.
        rise: of the block when the lift ended and after holding, mean over environments, m.
        warnings: of the solver (MuJoCo counts what did not converge).
    """

    control_steps: int
    wall: float
    cpu: float
    time_step: float
    rise: tuple[float, float]
    warnings: int = 0


@dataclass(frozen=True)
class Rate:
    """Median, least and greatest of the repetitions, control steps per second."""

    median: float
    least: float
    greatest: float

    @classmethod
    def of(cls, values: list[float]) -> Rate:
        return cls(float(np.median(values)), min(values), max(values))


@dataclass(frozen=True)
class Result:
    """A case, measured.

    Attributes:
        case: what.
        wall, cpu: control steps per second of wall and of CPU time, all processes together; a
            control step is one environment advanced by 0.05 s.
        time_step: of the solver, seconds.
        rise_after_lift, rise_after_hold: of the block, mean over environments, m.
        lifted, held: whether it followed the fingers by then.
        warnings: of the solver in one grasp.
        bytes_per_environment: resident memory that one environment more takes, on the CPU.
    """

    case: Case
    wall: Rate
    cpu: Rate
    time_step: float
    rise_after_lift: float
    rise_after_hold: float
    lifted: bool
    held: bool
    warnings: int
    bytes_per_environment: int

    def as_dict(self) -> dict[str, object]:
        """For JSON; `envs` is per process, rates are of all processes together."""
        case = self.case
        return {
            "solver": case.solver,
            "tets": case.tets,
            "envs": case.envs,
            "processes": case.processes,
            "device": case.device,
            "control_steps_per_second": self.wall.median,
            "control_steps_per_second_range": [self.wall.least, self.wall.greatest],
            "control_steps_per_cpu_second": self.cpu.median,
            "control_steps_per_cpu_second_range": [self.cpu.least, self.cpu.greatest],
            "time_step": self.time_step,
            "rise_after_lift": self.rise_after_lift,
            "rise_after_hold": self.rise_after_hold,
            "lifted": self.lifted,
            "held": self.held,
            "reports_stress": case.solver == "codesign",
            "solver_warnings": self.warnings,
            "bytes_per_environment": self.bytes_per_environment,
        }
