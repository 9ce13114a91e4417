"""A small trained pair that was never trained: deterministic weights, moderate actions."""

from itertools import pairwise

import numpy as np

from codesign_policy.policy_file import TrainedPair

SPACE, PARAMETERS = "box-7", 21


def random_pair(design: np.ndarray | None = None, **about: object) -> TrainedPair:
    """For the stock fingers, or for a design of `SPACE`."""
    random = np.random.default_rng(7)
    design = np.zeros(0) if design is None else design
    sizes = [8 + len(design), 16, 14]
    return TrainedPair(
        tuple(random.normal(0, 0.3, pair).astype(np.float32) for pair in pairwise(sizes)),
        tuple(random.normal(0, 0.3, size).astype(np.float32) for size in sizes[1:]),
        design.astype(np.float32),
        {"space": SPACE if len(design) else "", **about},
    )
