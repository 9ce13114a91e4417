"""Moments of the sender's wall clock on our steady clock."""

from __future__ import annotations

SLEW = 10_000  # ns per command by which the clocks' difference follows
JUMP = 50_000_000  # ns; a larger change of the difference is a jump of the wall clock


class ClockMap:
    """Moves stamps of the wall clock to the steady one, without jerks.

    A look at two clocks can take long, when the thread is interrupted between them; so their
    difference follows slowly. A jump of the wall clock is taken over at once: a command from
    before it then counts as old or early, and is refused.

    Attributes:
        jumps: how often the wall clock was set.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._difference: int | None = None  # steady minus wall clock [ns]

    def steady(self, stamp: int, wall_now: int, steady_now: int) -> float:
        """A stamp of the wall clock as a moment of the steady clock [s]; arguments in ns."""
        seen = steady_now - wall_now
        if self._difference is None:
            self._difference = seen
        change = seen - self._difference
        if abs(change) > JUMP:
            self.jumps += 1
            self._difference = seen
        else:
            self._difference += min(max(change, -SLEW), SLEW)
        return (stamp + self._difference) * 1e-9
