"""Checks of the simulator against solutions known from mechanics, and its reference grasp.

`run` goes through the cases one after the other; `codesign sim validate` prints them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from codesign_sim.validation import bending, friction, grasp, motion, statics
from codesign_sim.validation.check import Check

__all__ = ["CASES", "Check", "run"]

# Name, the function that measures it, and about how many seconds it takes on one core.
CASES: dict[str, tuple[Callable[[], list[Check]], float]] = {
    "squeeze": (statics.squeeze, 0.7),
    "resting": (statics.resting, 0.2),
    "layers": (statics.layers, 0.2),
    "rotation": (motion.static_rotation, 0.1),
    "spin": (motion.spin, 0.3),
    "energy": (motion.energy, 2),
    "violent": (motion.violent_actions, 6),
    "cantilever": (bending.small_deflection, 8),
    "elastica": (bending.large_deflection, 2),
    "incline": (friction.incline, 1),
    "hold": (friction.hold_threshold, 9),
    "grasp": (grasp.reference, 1),
    "refinement": (grasp.refinement, 4),
}


def run(names: list[str] | None = None) -> Iterator[tuple[str, list[Check]]]:
    """Measures the named cases, or all, in turn.

    Raises:
        ValueError: a name that is not a case.
    """
    for name in names or list(CASES):
        if name not in CASES:
            raise ValueError(f"no validation case {name!r}; choose from {', '.join(CASES)}")
        yield name, CASES[name][0]()
