"""The driver on a simulated clock: its own states, checks and playback, no thread, no SDK.

What would go on the wire is logged as a control box logs it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from codesign_control.driver.arm_link import SERVO_MODE, ArmLink, Reply
from codesign_control.driver.box_log import SERVO_POINT
from codesign_control.driver.command_stream import Measured
from codesign_control.driver.config import DriverConfig
from codesign_control.driver.driver import XarmDriver

PORT = 502  # that servo points go to
REPORTS = 10  # until the driver has seen that the arm stands


class SimulatedLink(ArmLink):
    """A control box whose arm is at once where a point sends it; rounds as the wire does."""

    def __init__(self, config: DriverConfig, on_report: Callable[[np.ndarray], None]) -> None:
        self._config, self._on_report = config, on_report
        self.own_gripper_port = False
        self.joints = np.zeros(7)
        self.record: Callable[[np.ndarray, np.ndarray, np.ndarray], None] = lambda *_: None

    @property
    def connected(self) -> bool:
        return True

    @property
    def mode(self) -> int:
        return SERVO_MODE

    @property
    def state(self) -> int:
        return 2

    @property
    def version(self) -> str:
        return "simulated"

    def report(self) -> None:
        """Tells where the arm is."""
        self._on_report(self.joints.copy())

    def servo(self, joints: np.ndarray) -> Reply:
        """Takes one servo point (7,) [rad]."""
        wire = joints.astype(np.float32).astype(float)
        self.record(joints, wire, self.joints)
        self.joints = wire
        return Reply.DONE

    def connect(self) -> None: ...

    def close(self) -> None: ...

    def patience(self, seconds: float) -> None: ...

    def patience_while_streaming(self) -> None: ...

    def errors(self) -> tuple[int, int]:
        return 0, 0

    def clear(self) -> None: ...

    def enable(self) -> None: ...

    def stop(self) -> None: ...


class Rehearsal:
    """An enabled driver of a simulated arm without a gripper.

    Attributes:
        now: the simulated clock [s].
        sent: the last servo point, in the double precision of before the wire, (7,) [rad].
        records: what the box has logged; take them away when they get many.
    """

    def __init__(self, config: DriverConfig | None = None) -> None:
        self.config = config or DriverConfig(gripper="none")
        self.now = 0.0
        self.sent = np.zeros(7)
        self.records: list[dict[str, Any]] = []
        self._links: list[SimulatedLink] = []
        self.driver = XarmDriver(self.config, clock=lambda: self.now, make_link=self._make_link)
        self.driver._connect()
        self.driver.enable()

    def _make_link(
        self, config: DriverConfig, on_report: Callable[[np.ndarray], None]
    ) -> SimulatedLink:
        self._links.append(link := SimulatedLink(config, on_report))
        link.record = self._record
        return link

    def _record(self, point: np.ndarray, wire: np.ndarray, measured: np.ndarray) -> None:
        self.sent = point
        self.records.append(
            {
                "t": self.now,
                "command": SERVO_POINT,
                "port": PORT,
                "joints": wire.tolist(),
                "measured": measured.tolist(),
                "carried_out": True,
            }
        )

    @property
    def measured(self) -> Measured:
        """The newest report."""
        newest = self.driver.measured
        assert newest is not None
        return newest

    def place(self, joints: np.ndarray) -> None:
        """Somebody puts the arm there, (7,) [rad], while nothing streams."""
        self._links[-1].joints = np.asarray(joints, dtype=np.float32).astype(float)
        self.sent = self._links[-1].joints.copy()
        for _ in range(REPORTS):
            self.tick()

    def tick(self) -> None:
        """One period: a report comes in, a servo point goes out if the driver has one."""
        self._links[-1].report()
        self.driver._tick(self.now)
        self.now += self.config.period
