"""Plays set-points at the driver's own rate, a little after their moments, without any jump.

The moment that is played goes on with the clock. Where commands stay away it slows down before the
last one, so the arm stops on its path instead of beyond it; where they come back it goes 1.2 times
as fast until it has caught up. A late thread plays on from where it was.
"""

from __future__ import annotations

import math

import numpy as np

from codesign_control.driver.config import DriverConfig
from codesign_control.setpoint_buffer import SetpointBuffer

CATCH_UP = 1.2  # fastest play, of real time
RAMP = 0.05  # change of the play's speed in one tick, upwards
BRAKING = 0.025  # s of set-points left below which play slows down; full speed to 0 in 50 ms
STANDING = 0.02  # rad/s; a last set-point that is slower ends a stop by itself
LARGEST_LAG = 0.3  # s; a play that is further behind is given up


class Playback:
    """Set-points (7,) [rad] with their moments [s, steady clock]; one thread uses it."""

    def __init__(self, config: DriverConfig) -> None:
        self._config = config
        self._points = SetpointBuffer()
        self._moment = self._newest = -math.inf
        self._speed = 1.0
        self._last, self._last_speed = np.zeros(7), 0.0
        self._offset = np.zeros(7)
        self._offset_left = 0.0

    def begin(self, moment: float, position: np.ndarray, measured: np.ndarray) -> None:
        """Starts at a set-point; what the arm is away from it is blended out, beginning with it."""
        self._points.clear()
        self._points.add(moment, position)
        self._newest = moment
        self._last, self._last_speed = position, 0.0
        # A period earlier: the next tick then plays at full speed, and has nothing to catch up on.
        self._moment = moment - self._config.delay - self._config.period
        self._speed = 1.0
        self._offset = np.asarray(measured, float) - position
        self._offset_left = 1.0

    def add(self, moment: float, position: np.ndarray) -> None:
        """Appends a set-point that is meant for a later moment than those before."""
        self._points.add(moment, position)
        moved = float(np.abs(position - self._last).max())
        self._last_speed = moved / max(moment - self._newest, 1e-6)
        self._last = position
        self._newest = moment

    @property
    def left(self) -> float:
        """Time that can still be played [s]."""
        return self._newest - self._moment

    def lag(self, now: float) -> float:
        """How far play is behind its time [s]."""
        return now - self._config.delay - self._moment

    def next(self, now: float) -> np.ndarray:
        """The point of the next tick. Call once per tick, after `begin`."""
        period = self._config.period
        wanted = min(max(self.lag(now) / period, 0.0), CATCH_UP)
        if self._last_speed > STANDING:
            wanted = min(wanted, math.sqrt(max(self.left, 0.0) / BRAKING))
        self._speed = min(wanted, self._speed + RAMP)
        self._moment = min(self._moment + self._speed * period, self._newest)
        point = self._points.at(self._moment)
        assert point is not None
        # From 1 to 0 with a level start and end: no step in velocity.
        blend = self._offset_left * self._offset_left * (3.0 - 2.0 * self._offset_left)
        self._offset_left = max(0.0, self._offset_left - period / self._config.blend_time)
        return point + blend * self._offset
