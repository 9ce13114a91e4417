"""Frames of the arm's TCP protocol: what a controller sends and understands."""

import struct
from dataclasses import dataclass

import numpy as np

CONTROL, CONTROL_2, NORMAL, RICH, REAL = 502, 503, 30001, 30002, 30003
VERSION = "7,7,XI1305A0001,AC1305A0001,v2.6.103"
NAMES = {
    1: "get_version", 11: "motion_enable", 12: "set_state", 13: "get_state", 14: "get_cmdnum",
    15: "get_error", 16: "clean_error", 17: "clean_warning", 19: "set_mode", 29: "servo_j",
    36: "set_load", 37: "set_collision_sensitivity", 41: "get_tcp_pose", 42: "get_joints",
    124: "gripper", 127: "write_tool", 128: "read_tool",
}  # fmt: skip
BAUD_2M = 11  # index in the SDK's list of baud rates


@dataclass(frozen=True)
class Request:
    """One frame from a client."""

    transaction: int
    protocol: int
    function: int
    data: bytes

    @property
    def name(self) -> str:
        return NAMES.get(self.function, f"function_{self.function}")


def take_requests(buffer: bytearray) -> list[Request]:
    """The complete frames at the front of a buffer, which they leave."""
    found = []
    while len(buffer) >= 6:
        transaction, protocol, length = struct.unpack(">HHH", buffer[:6])
        if len(buffer) < 6 + length or length < 1:
            break
        found.append(Request(transaction, protocol, buffer[6], bytes(buffer[7 : 6 + length])))
        del buffer[: 6 + length]
    return found


def reply(request: Request, status: int, data: bytes = b"") -> bytes:
    """The answer to a request: header, function, state byte, data."""
    head = struct.pack(
        ">HHHB", request.transaction, request.protocol, len(data) + 2, request.function
    )
    return head + bytes([status]) + data


def floats(values: object) -> bytes:
    """Little-endian single precision, as all reals of the protocol."""
    array = np.asarray(values, dtype="<f4")
    return array.tobytes()


def report(port: int, mode: int, state: int, joints: np.ndarray, error: int, warning: int) -> bytes:
    """One report of the size that belongs to the port (145, 245 or 135 bytes)."""
    body = bytes([(mode << 4) | state]) + struct.pack(">H", 0)
    body += floats(joints) + floats([450.0, 0.0, 250.0, 3.1415926, 0.0, 0.0]) + floats([0.0] * 7)
    if port == REAL:
        return _sized(body + floats([0.0] * 12))
    enabled = 0xFF if state in (0, 1, 2, 3) else 0
    body += bytes([enabled, enabled, error, warning]) + floats([0.0] * 6) + floats([0.0] * 4)
    body += bytes([3, 3]) + floats([0.0, 0.0, -1.0])
    if port == NORMAL:
        return _sized(body)
    body += bytes([7, 7, 0, 0, 0, 0]) + VERSION[-8:].encode().ljust(30, b"\0")
    body += floats([1000.0, 1.0, 50000.0, 0.1, 1000.0]) + floats([20.0, 0.01, 20.0, 0.0001, 4.0])
    return _sized(body + floats([2.3, 2.7]) + bytes(16))


def _sized(body: bytes) -> bytes:
    return struct.pack(">I", len(body) + 4) + body
