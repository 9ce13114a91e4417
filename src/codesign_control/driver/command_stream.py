"""Decides, tick by tick, what goes to the arm. No thread, no clock, no SDK."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

from codesign_control.driver.command_checks import CommandChecks, CommandRefused
from codesign_control.driver.config import DriverConfig
from codesign_control.driver.playback import LARGEST_LAG, Playback


@dataclass(frozen=True)
class Measured:
    """The arm's posture: moment (steady clock) [s], position [rad], velocity [rad/s], (7,) each."""

    moment: float
    position: np.ndarray
    velocity: np.ndarray


class CommandStream:
    """From commands at their sender's pace to servo points at the driver's.

    It begins to play where two commands in a row stand still at the measured posture, and from
    there on never jumps. It pauses where commands stay away, and must match again then.

    `command` may be called from any thread, everything else from one.

    Attributes:
        playing: whether points go out.
        message: why not.
        pauses: how often it stopped by itself.
        held: points that the last check before the arm stopped.
    """

    def __init__(self, config: DriverConfig) -> None:
        self.config = config
        self.checks = CommandChecks(config)
        self.playing = False
        self.message = ""
        self.pauses = 0
        self.held = 0
        self._playback = Playback(config)
        self._inbox: deque[tuple[float, np.ndarray]] = deque(maxlen=256)
        self._candidate: tuple[float, np.ndarray] | None = None
        self._last_sent = np.zeros(7)
        self._command_at = 0.0
        self._one_at_a_time = threading.Lock()

    def command(self, position: object, moment: float, now: float) -> None:
        """Takes a set-point (7,) [rad] meant for a moment; times on one steady clock [s].

        Raises:
            CommandRefused: it goes no further; counted by its reason.
        """
        with self._one_at_a_time:
            try:
                joints = self.checks.check(position, moment, now)
            except CommandRefused:
                if not self.playing:  # a jump is where a stream begins anew, from the next one on
                    self.checks.forget()
                raise
            self._command_at = now
            self._inbox.append((moment, joints))

    def reset(self, message: str = "waiting for commands that match the posture") -> None:
        """Stops playing; the next command must match the measured posture."""
        self.playing = False
        self.message = message
        self._candidate = None
        self._inbox.clear()
        self.checks.forget()

    def tick(self, now: float, measured: Measured | None) -> np.ndarray | None:
        """The servo point (7,) [rad] of this tick; None: nothing goes out."""
        if not self.playing:
            self._match(now, measured)
        if not self.playing:
            return None
        while self._inbox:
            self._playback.add(*self._inbox.popleft())
        why = self._too_late(now)
        if why:
            self._pause(why)
            return None
        point = self._playback.next(now)
        why = self._not_to_be_sent(point)
        if why:
            self.held += 1
            self._pause(why)
            return None
        self._last_sent = point
        return point

    def _pause(self, why: str) -> None:
        self.pauses += 1
        self.reset(f"paused: {why}; waiting for commands that match the posture")

    def _too_late(self, now: float) -> str | None:
        silent = now - self._command_at
        if silent > self.config.command_timeout:
            return f"no command for {silent:.2f} s"
        lag = self._playback.lag(now)
        return f"{lag:.2f} s behind" if lag > LARGEST_LAG else None

    def _not_to_be_sent(self, point: np.ndarray) -> str | None:
        """The last look, whatever went before."""
        try:
            self.checks.joints(point)
        except CommandRefused as refusal:
            return str(refusal)
        step = float(np.abs(point - self._last_sent).max())
        if step > self.config.largest_step + 1e-9:
            return f"a step of {step:.4f} rad, at most {self.config.largest_step:.4f} rad"
        return None

    def _match(self, now: float, measured: Measured | None) -> None:
        """Begins to play where two commands in a row stand still at the measured posture."""
        while self._inbox:
            moment, joints = self._inbox.popleft()
            before, self._candidate = self._candidate, (moment, joints)
            if before is None or measured is None:
                continue
            speed = float(np.abs(joints - before[1]).max()) / max(moment - before[0], 1e-6)
            why = self._mismatch(joints, speed, measured, now)
            if why:
                self.checks.count(CommandRefused("no_match", why))
                continue
            self._playback.begin(moment, joints, measured.position)
            self._last_sent = measured.position
            self.playing, self.message = True, "streaming"
            return

    def _mismatch(
        self, joints: np.ndarray, speed: float, measured: Measured, now: float
    ) -> str | None:
        config = self.config
        if now - measured.moment > config.report_timeout:
            return "the measured posture is old"
        apart = np.abs(joints - measured.position)
        if apart.max() > config.match_tolerance:
            k = int(np.argmax(apart))
            return (
                f"joint {k + 1} is commanded {apart[k]:.4f} rad away from where it is, "
                f"at most {config.match_tolerance} rad to begin: enable the controller anew"
            )
        if speed > config.match_speed:
            return f"commands move at {speed:.3f} rad/s: to begin at most {config.match_speed}"
        arm_speed = float(np.abs(measured.velocity).max())
        if arm_speed > config.match_speed:
            return f"the arm moves at {arm_speed:.3f} rad/s: to begin at most {config.match_speed}"
        return None
