"""Random designs of a space, built and judged: how far the build can be trusted."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_design.base_mesh import UNIT_LENGTH
from codesign_design.build import finish_finger, shape_finger
from codesign_design.design_space import DesignSpace, design_space


@dataclass(frozen=True)
class RandomDesign:
    """Which design: handles displaced by normal noise of `sigma`, in unit-sphere units."""

    space: str
    sigma: float
    seed: int
    index: int

    def parameters(self, space: DesignSpace) -> NDArray[np.float64]:
        """Its design action (3N,), kept within the space's bounds."""
        noise = np.random.default_rng([self.seed, self.index]).normal(size=space.parameter_count)
        limit = space.parameter_limit
        return np.clip(noise * self.sigma * UNIT_LENGTH / space.scale, -limit, limit)


@dataclass(frozen=True)
class Outcome:
    """How it went.

    Attributes:
        design: which one.
        seconds: CPU time from parameters to the mounted and checked mesh.
        report_seconds: CPU time of all else: the mirrored pair and the measures of the report.
        remeshed: the raw surface was not valid.
        problems: why the mesh is not valid; empty if it is.
        print_problems: why the finger cannot be printed or used; empty if it can.
    """

    design: RandomDesign
    seconds: float
    report_seconds: float
    remeshed: bool
    problems: tuple[str, ...]
    print_problems: tuple[str, ...]


def build_random(design: RandomDesign) -> Outcome:
    """Builds one random design."""
    space = design_space(design.space)
    parameters = design.parameters(space)
    started = time.process_time()
    raw = space.surface(parameters)
    shape = shape_finger(raw)
    shaped = time.process_time()
    report = finish_finger(raw, shape, cage=space.name, parameters=parameters).report
    reported = time.process_time()
    mesh_problems = tuple(report.mesh.problems)
    return Outcome(
        design,
        seconds=shaped - started,
        report_seconds=reported - shaped,
        remeshed=report.deviation.remeshed,
        problems=mesh_problems,
        print_problems=tuple(p for p in report.problems if p not in mesh_problems),
    )
