"""What a joint command must be before anything of the arm's SDK sees it.

The SDK passes on NaN, infinities and jumps of 3 rad without complaint.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from codesign_control.driver.config import DriverConfig

# Why commands are refused; the keys of `CommandChecks.refused`.
REASONS = (
    "wrong_length",
    "not_finite",
    "outside_limits",
    "stale",
    "wrong_clock",
    "out_of_order",
    "too_fast",
    "no_match",
)
LONGEST_GAP = 0.05  # s between two commands that still counts as time to move in
ROUNDING = 1.01  # of the velocity: moments come from two clocks that drift


class CommandRefused(ValueError):
    """A command that goes no further.

    Attributes:
        reason: one of REASONS.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class CommandChecks:
    """Checks one stream of joint commands and counts what it refuses.

    Attributes:
        refused: how often, by reason.
        last_refusal: the newest one's message.
    """

    def __init__(self, config: DriverConfig) -> None:
        self._config = config
        self._lower = np.array(config.joint_lower)
        self._upper = np.array(config.joint_upper)
        self._last: tuple[float, np.ndarray] | None = None
        self.refused: Counter[str] = Counter()
        self.last_refusal = ""

    def forget(self) -> None:
        """The next command begins a new stream: it has no predecessor."""
        self._last = None

    def check(self, position: object, moment: float, now: float) -> np.ndarray:
        """`position` as (7,) [rad], when it may be streamed.

        Args:
            position: seven angles.
            moment: what it is meant for, and `now`: both on one steady clock [s].

        Raises:
            CommandRefused: it may not; counted.
        """
        try:
            joints = self.joints(position)
            self._check_time(moment, now)
            self._check_step(joints, moment)
        except CommandRefused as refusal:
            self.count(refusal)
            raise
        self._last = (moment, joints)
        return joints

    def count(self, refusal: CommandRefused) -> None:
        """Counts a refusal that was decided elsewhere."""
        self.refused[refusal.reason] += 1
        self.last_refusal = str(refusal)

    def joints(self, position: object) -> np.ndarray:
        """`position` as seven finite angles inside the limits [rad].

        Raises:
            CommandRefused: it is not that.
        """
        try:
            joints = np.array(position, dtype=float)
        except (TypeError, ValueError):
            raise CommandRefused("wrong_length", "joint command: not a list of numbers") from None
        if joints.shape != (7,):
            raise CommandRefused(
                "wrong_length", f"joint command: shape {joints.shape}, expected (7,)"
            )
        if not np.isfinite(joints).all():
            raise CommandRefused("not_finite", f"joint command: not finite: {joints.tolist()}")
        outside = (joints < self._lower) | (joints > self._upper)
        if outside.any():
            k = int(np.argmax(outside))
            raise CommandRefused(
                "outside_limits",
                f"joint {k + 1}: {joints[k]:.4f} rad, "
                f"limits {self._lower[k]:.4f}..{self._upper[k]:.4f} rad",
            )
        return joints

    def _check_time(self, moment: float, now: float) -> None:
        config = self._config
        if not np.isfinite(moment):
            raise CommandRefused("wrong_clock", f"joint command: moment {moment}: not finite")
        if moment < now - config.command_timeout:
            raise CommandRefused(
                "stale",
                f"joint command is {now - moment:.3f} s old, at most {config.command_timeout} s",
            )
        if moment > now + config.early_limit:
            raise CommandRefused(
                "wrong_clock",
                f"joint command is meant for {moment - now:.3f} s from now, "
                f"at most {config.early_limit} s: are the clocks set?",
            )
        if self._last is not None and moment <= self._last[0]:
            raise CommandRefused("out_of_order", "joint command older than the one before")

    def _check_step(self, joints: np.ndarray, moment: float) -> None:
        if self._last is None:
            return
        elapsed = min(moment - self._last[0], LONGEST_GAP)
        step = np.abs(joints - self._last[1])
        allowed = self._config.joint_velocity * elapsed * ROUNDING
        if (step > allowed).any():
            k = int(np.argmax(step))
            raise CommandRefused(
                "too_fast",
                f"joint {k + 1} jumps by {step[k]:.4f} rad within {elapsed * 1e3:.1f} ms, "
                f"limit {self._config.joint_velocity} rad/s",
            )
