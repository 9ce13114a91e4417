"""Driver, fake box and someone who commands, in the test's own process."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from codesign_control.driver import (
    CommandRefused,
    DriverConfig,
    DriverState,
    GripperReading,
    Measured,
    XarmDriver,
    prioritize_process,
)
from tests.fake_box import FakeBox, wait_for

PERIOD = 0.01  # s between two commands, as of the controller


class Commander:
    """Sends a set-point every 10 ms, as the controller does: a posture plus a path.

    Attributes:
        posture: (7,) [rad].
        path: seconds since it was set -> (7,) [rad], added to the posture.
        sent, refused: counts.
    """

    def __init__(self, driver: XarmDriver) -> None:
        self._driver = driver
        self.posture: Any = np.zeros(7)
        self._path: Callable[[float], Any] = lambda _: np.zeros(7)
        self._since = 0.0
        self.paused = True
        self.sent = self.refused = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def hold(self, posture: Any) -> None:
        """Commands one posture from now on."""
        self._path = lambda _: np.zeros(7)
        self.posture = np.array(posture, dtype=float)
        self.paused = False

    def follow(self, path: Callable[[float], Any]) -> None:
        """Adds a path to the posture from now on."""
        self._since = time.monotonic()
        self._path = path

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            due += PERIOD
            time.sleep(max(0.0, due - time.monotonic()))
            if self.paused:
                continue
            position = self.posture + self._path(max(due - self._since, 0.0))
            self.sent += 1
            try:
                self._driver.command(position, due)
            except CommandRefused:
                self.refused += 1


class Rig:
    """Use it as a context; settings are those of `DriverConfig`."""

    def __init__(self, *, box: dict[str, Any] | None = None, **settings: Any) -> None:
        self.box = FakeBox(**(box or {}))
        self.config = DriverConfig(address=self.box.address, **settings)
        self.reports: list[Measured] = []
        self.readings: list[GripperReading] = []

    def __enter__(self) -> Rig:
        self._switch_interval = sys.getswitchinterval()
        sys.setswitchinterval(1e-3)
        # A busy machine is no fault of the driver: this process keeps its time, where permitted.
        prioritize_process(10)
        self.box.__enter__()
        self.driver = self.new_driver()
        self.commander = Commander(self.driver)
        return self

    def __exit__(self, *error: object) -> None:
        self.commander.close()
        self.driver.close()
        violations = self.box.violations(largest_step=self.config.largest_step + 1e-6)
        self.box.__exit__()
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.sched_setscheduler(int(thread), os.SCHED_OTHER, os.sched_param(0))
        sys.setswitchinterval(self._switch_interval)
        assert error[0] is not None or not violations, violations[:5]

    def new_driver(self) -> XarmDriver:
        """Started and connected."""
        driver = XarmDriver(self.config, self.reports.append, self.readings.append)
        driver.start()
        wait_for(
            lambda: driver.measured and driver.state in (DriverState.DISABLED, DriverState.FAULT),
            10.0,
            "the driver is connected",
        )
        return driver

    def restart_driver(self) -> None:
        """The old one ends; the new one knows nothing of it."""
        self.driver.close()
        self.driver = self.commander._driver = self.new_driver()

    def stream(self) -> None:
        """Enables, commands the measured posture, and waits until points go out."""
        self.driver.enable()
        self.match()

    def match(self) -> None:
        """Commands the measured posture until points go out."""
        measured = self.driver.measured
        assert measured is not None
        self.commander.hold(measured.position)
        self.wait_for(DriverState.STREAMING)

    def wait_for(self, state: DriverState, timeout: float = 5.0) -> None:
        wait_for(
            lambda: self.driver.state is state,
            timeout,
            f"driver {state.name}, is {self.driver.state.name}: {self.driver.status().message}",
        )

    def joints(self) -> np.ndarray:
        """Where the box's arm is (7,) [rad]."""
        return np.array(self.box.switch()["joints"])


def turned(posture: Any, angle: float, joint: int = 1) -> np.ndarray:
    """A posture (7,) with one joint turned by an angle [rad]."""
    result = np.array(posture, dtype=float)
    result[joint - 1] += angle
    return result


def wave(amplitude: float = 0.3, speed: float = 2.0) -> Callable[[float], np.ndarray]:
    """Joints 1 and 6 to and fro: amplitude [rad], angular speed [rad/s]; starts at rest."""
    shape = np.array([1.0, 0.0, 0.0, 0.0, 0.0, -0.7, 0.0])
    return lambda t: shape * amplitude * (1.0 - np.cos(speed * t)) / 2.0
