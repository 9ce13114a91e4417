"""A control box without an arm: enough of the arm's TCP protocol for the real SDK.

    with FakeBox() as box:
        driver = ...(box.address)
        box.switch(error=31)
        assert not box.violations()

It runs as a process of its own on a loopback alias and logs every command that it receives.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from codesign_control.driver import box_log

ROOT = Path(__file__).parents[2]
_aliases = itertools.count(1)


class FakeBox:
    """The box as a process; use it as a context.

    Attributes:
        address: where it listens, a free 127.x.y.z.
        log_path: JSON lines: every command and event with its moment of CLOCK_MONOTONIC.
    """

    def __init__(
        self,
        joints: Sequence[float] | None = None,
        log: Path | None = None,
        *,
        realtime: bool = True,
        second_port: bool = True,
    ) -> None:
        """Starts nothing yet.

        Args:
            joints: first posture (7,) [rad].
            log: file for the log; default: a temporary one.
            realtime: where permitted under SCHED_FIFO, as a real box waits for nobody.
            second_port: whether it has port 503, as firmware from 1.11 on.
        """
        self.address = free_address()
        # In memory where possible: a busy disk would make the box hang.
        memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        self._folder = tempfile.TemporaryDirectory(prefix="fake-box-", dir=memory)
        self.log_path = log or Path(self._folder.name, "box.jsonl")
        self._joints = joints
        self._second_port = second_port
        self._realtime = realtime
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> FakeBox:
        command = [sys.executable, "-m", "tests.fake_box", "--address", self.address]
        command += ["--log", str(self.log_path)]
        if self._joints is not None:
            command += ["--joints", *(f"{q:.9f}" for q in self._joints)]
        if not self._second_port:
            command += ["--no-second-port"]
        self._process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            preexec_fn=_realtime if self._realtime else None,
        )
        deadline = time.monotonic() + 20.0
        while True:
            try:
                self.switch()
                return self
            except OSError:
                if time.monotonic() > deadline or self._process.poll() is not None:
                    self.__exit__()
                    raise RuntimeError(f"the fake box did not start on {self.address}") from None
                time.sleep(0.05)

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._folder.cleanup()

    def switch(self, **switches: Any) -> dict[str, Any]:
        """Sets switches (`server.Box._set` has them all) and returns the box's state.

        error=31, emergency_stop=2 (held until emergency_stop=0), hung=True, silent=True (no
        reports), drop=True, offline=True, delay=0.02 [s], joints=[...], state=3, mode=0,
        gripper_error=11, gripper_obstacle=400.
        """
        with socket.create_connection((self.address, 30900), 5.0) as connection:
            connection.sendall(json.dumps(switches).encode() + b"\n")
            return json.loads(connection.makefile().readline())

    def records(self, since: float = -np.inf) -> list[dict[str, Any]]:
        """What the box has logged from a moment of CLOCK_MONOTONIC on."""
        found = []
        for line in self.log_path.read_text().splitlines():
            with contextlib.suppress(ValueError):  # the line that is being written
                record = json.loads(line)
                if record["t"] >= since:
                    found.append(record)
        return found

    def commands(self, *names: str, since: float = -np.inf) -> list[dict[str, Any]]:
        """The logged commands of these names, or all of them."""
        return [
            r
            for r in self.records(since)
            if "command" in r and (not names or r["command"] in names)
        ]

    def servo_points(self, since: float = -np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Every servo point that came: moments (n,) [s] and joints (n, 7) [rad]."""
        records = self.commands("servo_j", since=since)
        times = np.array([r["t"] for r in records])
        return times, np.array([r["joints"] for r in records]).reshape(-1, 7)

    def violations(
        self, largest_step: float = 0.0151, first_step: float = 0.0105, pause: float = 0.2
    ) -> list[str]:
        """What must never be on the wire, one line each.

        Not finite, outside the joint limits, further than `largest_step` rad from the point
        before, or, after a pause [s] or an error, further than `first_step` rad from where the
        arm was.
        """
        return box_log.violations(self.records(), largest_step, first_step, pause)


def wait_for(condition: Callable[[], Any], timeout: float, what: str) -> Any:
    """The first true value of `condition`; AssertionError after `timeout` [s]."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        if value := condition():
            return value
        time.sleep(0.005)
    raise AssertionError(f"not within {timeout} s: {what}")


def free_address() -> str:
    """A loopback alias on which the protocol's ports are free.

    Raises:
        PermissionError: port 502 may not be bound here; in a test it is skipped.
    """
    for _ in range(100):
        number = (os.getpid() * 101 + next(_aliases)) % 64_000
        address = f"127.{1 + number // 250 % 250}.{number % 250}.7"
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, 502))
                return address
            except PermissionError:
                remedy = "run as root, or set net.ipv4.ip_unprivileged_port_start=0"
                if "PYTEST_CURRENT_TEST" in os.environ:
                    pytest.skip(f"the arm's port 502 may not be bound here: {remedy}")
                raise PermissionError(f"port 502 may not be bound: {remedy}") from None
            except OSError:
                continue
    raise RuntimeError("no free loopback alias")


def _realtime() -> None:
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
