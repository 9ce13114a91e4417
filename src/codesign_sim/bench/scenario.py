"""What is timed: fingers close on the tofu, lift it and hold it, in 20 Hz control steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from codesign_sim.mesh import SurfaceMesh

CONTROL_PERIOD = 0.05  # s, the paper's 20 Hz
CLOSE, LIFT, HOLD = 10, 20, 10  # control steps
STEPS = CLOSE + LIFT + HOLD
OPEN, CLOSED = 0.034, 0.026  # m, gaps
RISE = 0.1  # m
RISE_HELD = 0.7  # share of the rise that a held block follows
_CENTRE = 0.026  # m, height of the fingers' middle above the table before the lift

Fingers = tuple[SurfaceMesh, SurfaceMesh]


@dataclass(frozen=True)
class Pose:
    """Gap between the fingers and height of the grasp frame, metres."""

    width: float
    height: float


def pose(fingers: Fingers, step: float) -> Pose:
    """Where the fingers are after `step` control steps; fractions are between two of them."""
    closing = min(step / CLOSE, 1.0)
    rise = RISE * min(max((step - CLOSE) / LIFT, 0.0), 1.0)
    z = np.concatenate([mesh.vertices[:, 2] for mesh in fingers])
    middle = (z.min() + z.max()) / 2  # below the grasp frame's origin, whose z points down
    return Pose(OPEN + closing * (CLOSED - OPEN), _CENTRE + middle + rise)
