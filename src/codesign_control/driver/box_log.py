"""Whether the log of a control box holds a servo point that should never have been on the wire.

A record has the moment `t` [s], the `command`, and for servo points `joints`, and `measured`, where
the arm was when it came, (7,) [rad] each. The limits are stated here once more, apart from those
that the driver goes by.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

SERVO_POINT = "servo_j"
# SDK x_config.py, xArm7 from serial XI1305 on; J6 as xarm_ros2.
LOWER = np.array([-6.28319, -2.04204, -6.28319, -0.10472, -6.28319, -1.69297, -6.28319])  # rad
UPPER = np.array([6.28319, 2.02459, 6.28319, 3.92700, 6.28319, 3.14160, 6.28319])  # rad
ROUNDING = 2e-6  # rad: the wire carries single precision


def violations(
    records: Iterable[Mapping[str, Any]],
    largest_step: float = 0.0151,
    first_step: float = 0.0105,
    pause: float = 0.2,
) -> list[str]:
    """What must never be on the wire, one line each.

    Not finite, outside the joint limits, further than `largest_step` rad from the point before,
    or, after a pause [s] or an error, further than `first_step` rad from where the arm was.
    """
    found, before, when = [], None, -np.inf
    for record in records:
        if record.get("command") != SERVO_POINT:
            continue
        point = np.array(record["joints"], float)
        at = f"t={record['t']:.3f}"
        if point.shape != (7,) or not np.isfinite(point).all():
            found.append(f"{at}: not finite: {point.tolist()}")
            continue
        if (point < LOWER - ROUNDING).any() or (point > UPPER + ROUNDING).any():
            found.append(f"{at}: outside the joint limits: {point.tolist()}")
        begins = before is None or record["t"] - when > pause
        reference = np.array(record["measured"]) if begins else before
        step = float(np.abs(point - reference).max())
        if step > (first_step if begins else largest_step) + ROUNDING:
            found.append(f"{at}: step of {step:.4f} rad ({'first' if begins else 'next'} point)")
        before, when = point, record["t"]
    return found
