"""A small block and finger targets for the tests."""

import numpy as np

from codesign_sim import Block, FingerTargets

# A coarse tofu: large cells, hence large time steps and fast tests.
SMALL = Block(cells=(5, 3, 4))


def around(width: float, height: float = 0.026, environments: int = 1) -> FingerTargets:
    place = np.tile([0.0, 0.0, height], (environments, 1))
    return FingerTargets.from_above(place, width)
