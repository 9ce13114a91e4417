"""Set-points in the order of their moments, read a little later: jitter stays out of the motion."""

from __future__ import annotations

from collections import deque

import numpy as np

from codesign_control.pose import finite_vector

KEPT = 64  # set-points; 0.6 s at 100 Hz
OUT_OF_STEP = 0.5  # s; sender and reader whose clocks differ more have no common time


class SetpointBuffer:
    """Joint set-points (7,) [rad], each meant for one moment [s] of the sender's clock.

    Or vectors of any other size, such as what an arm reports.
    """

    def __init__(self, size: int = 7) -> None:
        self._size = size
        self._points: deque[tuple[float, np.ndarray]] = deque(maxlen=KEPT)

    def __len__(self) -> int:
        return len(self._points)

    def clear(self) -> None:
        """Forgets everything."""
        self._points.clear()

    def add(self, moment: float, position: np.ndarray) -> None:
        """Appends a set-point. A clock that was put back starts the buffer anew.

        Raises ValueError for a position of another size, or that is not finite.
        """
        position = finite_vector("joint command", position, self._size)
        if self._points and moment <= self._points[-1][0]:
            self._points.clear()
        self._points.append((moment, position))

    def at(self, moment: float) -> np.ndarray | None:
        """The set-point at a moment, linear in between; the first or the last one outside.

        None without any. When the clocks of sender and reader do not agree: the last one.
        """
        if not self._points:
            return None
        moments = [m for m, _ in self._points]
        if abs(moment - moments[-1]) > OUT_OF_STEP:
            return self._points[-1][1]
        after = int(np.searchsorted(moments, moment))
        if after == 0:
            return self._points[0][1]
        if after == len(moments):
            return self._points[-1][1]
        (t0, q0), (t1, q1) = self._points[after - 1], self._points[after]
        return q0 + (moment - t0) / (t1 - t0) * (q1 - q0)
