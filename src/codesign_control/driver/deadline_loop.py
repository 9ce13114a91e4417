"""A thread that wakes at absolute deadlines, and remembers how far off it was."""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

KEPT = 75_000  # ticks: five minutes at 250 Hz
FIFO_PRIORITY = 40  # of 1..99, the streaming thread's; others of the process lie below


@dataclass(frozen=True)
class Deviation:
    """Of wake-ups from their deadlines [ms]; nan without any."""

    p50: float
    p99: float
    max: float
    ticks: int


class DeadlineLoop:
    """Calls `step(now)` every `period` s in a thread of its own until stopped.

    A step that takes too long costs whole ticks, never a shifted grid.

    Attributes:
        missed: ticks that were left out because the one before took too long.
        fifo: whether the thread runs under SCHED_FIFO.
    """

    def __init__(
        self, period: float, step: Callable[[float], None], *, realtime: bool = False
    ) -> None:
        self.period = period
        self.missed = 0
        self.fifo = False
        self._step = step
        self._realtime = realtime
        self._deviations = np.zeros(KEPT)
        self._ticks = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ends it; waits for the step in hand."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def deviations(self) -> np.ndarray:
        """Lateness of the last wake-ups [s], in order, at most KEPT of them."""
        ticks = self._ticks
        if ticks <= KEPT:
            return self._deviations[:ticks].copy()
        return np.roll(self._deviations, -(ticks % KEPT))

    def deviation(self, last: int = KEPT) -> Deviation:
        """Percentiles over the last ticks."""
        values = self.deviations()[-last:] * 1e3
        if not len(values):
            return Deviation(math.nan, math.nan, math.nan, 0)
        p50, p99 = np.percentile(values, [50, 99])
        return Deviation(float(p50), float(p99), float(values.max()), len(values))

    def _run(self) -> None:
        if self._realtime:
            self.fifo = prioritize(threading.get_native_id(), FIFO_PRIORITY)
        due = time.monotonic()
        while not self._stop.is_set():
            due += self.period
            wait = due - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)  # clock_nanosleep to an absolute time
            elif wait < -self.period:
                late = int(-wait / self.period)
                self.missed += late
                due += late * self.period
                continue
            now = time.monotonic()
            self._deviations[self._ticks % KEPT] = now - due
            self._ticks += 1
            self._step(now)


def prioritize(thread: int, priority: int) -> bool:
    """SCHED_FIFO for a thread by its native id; False where that is not permitted."""
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(priority))
        return True
    return False


def lock_memory() -> bool:
    """Keeps this process's pages in memory, now and later; False where that is not permitted.

    A page that has to come back from the disk stops whoever needs it for that long.
    """
    current_and_future = 1 | 2  # MCL_CURRENT, MCL_FUTURE of <sys/mman.h>
    return ctypes.CDLL(None).mlockall(current_and_future) == 0


def prioritize_process(priority: int) -> bool:
    """SCHED_FIFO for every thread that this process has now; those they start inherit it.

    What shares the interpreter's lock with a real-time thread must not be kept from running
    while it holds that lock. False where that is not permitted.
    """
    threads = [int(name) for name in os.listdir("/proc/self/task")]
    with contextlib.suppress(ProcessLookupError):  # a thread that has just ended
        return not [t for t in threads if not prioritize(t, priority)]
    return True
