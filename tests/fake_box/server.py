"""The fake control box: one asyncio loop that serves, moves, reports, fails and logs."""

import asyncio
import contextlib
import json
import math
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.fake_box import protocol
from tests.fake_box.arm import Arm
from tests.fake_box.gripper import Gripper

SWITCHES = 30900  # our own port: JSON lines, one request and one answer each
REPORT_PERIOD = {protocol.REAL: 0.01, protocol.NORMAL: 0.2, protocol.RICH: 0.2}  # s


class Box:
    """Arm, gripper, sockets and switches of one control box on one address."""

    def __init__(
        self,
        address: str,
        log: Path,
        joints: list[float] | None = None,
        second_port: bool = True,
    ) -> None:
        self.address = address
        self.arm = Arm(np.array(joints)) if joints else Arm()
        self.gripper = Gripper()
        self.hung = False  # neither reads, answers nor reports
        self.silent = False  # answers, but does not report
        self.offline = False  # no listening sockets
        self.delay = 0.0  # s, of every answer
        self._second_port = second_port
        self._log = log.open("w", buffering=1)
        self._servers: dict[int, asyncio.Server] = {}
        self._clients: set[asyncio.StreamWriter] = set()
        self._handlers = {
            1: lambda _: protocol.VERSION.encode().ljust(40, b"\0"),
            11: self._motion_enable, 12: self._set_state, 13: lambda _: bytes([self.arm.state]),
            14: lambda _: struct.pack(">H", 0), 15: self._get_error, 16: self._clean_error,
            17: self._clean_warning, 19: self._set_mode, 29: self._servo, 36: lambda _: b"",
            37: lambda _: b"", 41: lambda _: protocol.floats([450, 0, 250, math.pi, 0, 0]),
            42: self._get_joints, 124: self._ask_gripper, 127: lambda _: b"",
            128: lambda _: struct.pack(">i", protocol.BAUD_2M),
        }  # fmt: skip

    async def run(self) -> None:
        """Serves until cancelled."""
        await asyncio.start_server(self._switch, self.address, SWITCHES)
        await self._listen()
        await asyncio.gather(*(self._report(port) for port in REPORT_PERIOD))

    async def _listen(self) -> None:
        control = (protocol.CONTROL, protocol.CONTROL_2)[: 1 + self._second_port]
        for port in (*control, *REPORT_PERIOD):
            serve = self._serve if port in control else self._keep
            self._servers[port] = await asyncio.start_server(
                lambda r, w, p=port, s=serve: s(r, w, p), self.address, port
            )

    def write_log(self, record: dict[str, Any]) -> None:
        """Appends a line: a moment of CLOCK_MONOTONIC [s], and what came."""
        self._log.write(json.dumps({"t": time.monotonic()} | record) + "\n")

    # --- clients

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, port: int
    ) -> None:
        """A control connection: frames in, answers out, in order."""
        self._clients.add(writer)
        self.write_log({"event": "connected", "port": port})
        buffer = bytearray()
        with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
            while data := await reader.read(4096):
                buffer += data
                for request in protocol.take_requests(buffer):
                    while self.hung:
                        await asyncio.sleep(0.002)
                    answer = self._handle(request, port)
                    if self.delay:
                        await asyncio.sleep(self.delay)
                    writer.write(answer)
                await writer.drain()
        self._clients.discard(writer)
        self.write_log({"event": "disconnected", "port": port})
        writer.close()

    async def _keep(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, port: int
    ) -> None:
        """A report connection: stays until the client leaves."""
        writer.report_port = port  # type: ignore[attr-defined]
        self._clients.add(writer)
        with contextlib.suppress(ConnectionError):
            while await reader.read(64):
                pass
        self._clients.discard(writer)
        writer.close()

    async def _report(self, port: int) -> None:
        due = time.monotonic()
        while True:
            due = max(due + REPORT_PERIOD[port], time.monotonic() - 0.1)
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            if self.hung or self.silent:
                continue
            self._advance()
            arm = self.arm
            data = protocol.report(port, arm.mode, arm.state, arm.joints, arm.error, arm.warning)
            for writer in list(self._clients):
                if getattr(writer, "report_port", None) == port and not writer.is_closing():
                    writer.write(data)

    # --- commands

    def _advance(self) -> None:
        now = time.monotonic()
        self.arm.advance(now)
        self.gripper.advance(now)

    def _handle(self, request: protocol.Request, port: int) -> bytes:
        self._advance()
        record: dict[str, Any] = {"command": request.name, "port": port}
        handler = self._handlers.get(request.function)
        self._record = record
        data = handler(request.data) if handler else b""
        if handler is None:
            record["unknown"] = True
        self.write_log(record)
        return protocol.reply(request, self.arm.status, data)

    def _motion_enable(self, data: bytes) -> bytes:
        self._record["value"] = data[1]
        self.arm.enabled = bool(data[1]) and not self.arm.error
        return b""

    def _set_state(self, data: bytes) -> bytes:
        self._record["value"] = data[0]
        self.arm.set_state(data[0])
        return b""

    def _set_mode(self, data: bytes) -> bytes:
        self._record["value"] = data[0]
        self.arm.set_mode(data[0])
        return b""

    def _get_error(self, _: bytes) -> bytes:
        return bytes([self.arm.error, self.arm.warning])

    def _clean_error(self, _: bytes) -> bytes:
        self.arm.clear_error()
        return b""

    def _clean_warning(self, _: bytes) -> bytes:
        self.arm.warning = 0
        return b""

    def _get_joints(self, data: bytes) -> bytes:
        vectors = data[0] & 0x0F if data else 1
        return protocol.floats(self.arm.joints) + protocol.floats([0.0] * 7 * (vectors - 1))

    def _servo(self, data: bytes) -> bytes:
        values = np.frombuffer(data[:28], "<f4").astype(float)
        self._record["joints"] = values.tolist()
        self._record["measured"] = self.arm.joints.tolist()
        self._record["carried_out"] = len(values) == 7 and self.arm.servo(values)
        return b""

    def _ask_gripper(self, data: bytes) -> bytes:
        answer, asked = self.gripper.answer(data[1:])
        self._record |= asked
        return data[:1] + answer

    # --- switches

    async def _switch(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            request = json.loads(line)
            for name, value in request.items():
                self.write_log({"event": "switch", name: value})
                await self._set(name, value)
            writer.write(json.dumps(self._state()).encode() + b"\n")
        writer.close()

    async def _set(self, name: str, value: Any) -> None:
        self._advance()
        if name == "error":
            self.arm.fail(int(value))
        elif name == "emergency_stop":  # a pressed button: the code, or 0 when it is released
            if value:
                self.arm.fail(int(value), held=True)
            else:
                self.arm.error_held = False
        elif name == "joints":  # somebody moved the arm by hand
            self.arm.joints = np.array(value, float)
            self.arm.target = self.arm.joints.copy()
        elif name == "state":
            self.arm.set_state(int(value))
        elif name == "mode":
            self.arm.set_mode(int(value))
        elif name == "warning":
            self.arm.warning = int(value)
        elif name == "gripper_error":
            self.gripper.registers[0x000F] = int(value)
        elif name == "gripper_obstacle":
            self.gripper.obstacle = value
        elif name == "drop":
            self._close_clients()
        elif name == "offline":
            await self._go(offline=bool(value))
        elif name in ("hung", "silent", "delay"):
            setattr(self, name, value)

    def _close_clients(self) -> None:
        for writer in list(self._clients):
            writer.transport.abort()
        self._clients.clear()

    async def _go(self, *, offline: bool) -> None:
        if offline == self.offline:
            return
        self.offline = offline
        if not offline:
            await self._listen()
            return
        for server in self._servers.values():
            server.close()
        self._servers.clear()
        self._close_clients()

    def _state(self) -> dict[str, Any]:
        arm, gripper = self.arm, self.gripper
        return {
            "joints": arm.joints.tolist(), "mode": arm.mode, "state": arm.state,
            "enabled": arm.enabled, "error": arm.error, "points": arm.points,
            "gripper_position": gripper.position, "gripper_target": gripper.target,
            "gripper_enabled": bool(gripper.registers[0x0100]),
            "gripper_force": gripper.registers[0x0500], "hung": self.hung,
        }  # fmt: skip
