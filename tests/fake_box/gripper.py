"""The gripper behind the fake box: holding registers of G1 and G2, and a motor that moves."""

import math
import struct

ID = 8
ENABLE, MODE, SPEED, FORCE = 0x0100, 0x0101, 0x0303, 0x0500
STATUS, ERROR, RESET_ERROR = 0x0000, 0x000F, 0x0109
TARGET, POSITION = 0x0700, 0x0702  # two registers each, signed
G2_MOTION = 0x0C00  # enable, speed, force, target (2): five registers in one write
READ, WRITE = 0x03, 0x10
OPEN = 850  # pulses


class Gripper:
    """Position [pulses], driven to a target at the speed last set, or to an obstacle."""

    def __init__(self) -> None:
        self.registers = {ENABLE: 0, MODE: 0, SPEED: 3000, FORCE: 50, ERROR: 0}
        self.position = float(OPEN)
        self.target = OPEN
        self.obstacle: float | None = None  # pulses below which it cannot close
        self._time: float | None = None
        self._rate = 1000.0  # pulses/s

    def advance(self, now: float) -> None:
        """Moves on to a moment [s, any steady clock]."""
        elapsed = 0.0 if self._time is None else now - self._time
        self._time = now
        if not self.registers[ENABLE] or self.registers[ERROR]:
            return
        reach = self._rate * max(elapsed, 0.0)
        self.position += min(max(self.target - self.position, -reach), reach)
        if self.obstacle is not None:
            self.position = max(self.position, self.obstacle)

    @property
    def moving(self) -> bool:
        blocked = self.obstacle is not None and self.target < self.obstacle == self.position
        return abs(self.target - self.position) > 0.5 and not blocked

    def answer(self, request: bytes) -> tuple[bytes, dict[str, object]]:
        """The reply to a Modbus RTU request without checksum, and what it asked for."""
        slave, function, address, count = struct.unpack(">BBHH", request[:6])
        if slave != ID:
            return b"", {"gripper": "unknown slave", "slave": slave}
        if function == READ:
            words = [self._read(address + k) for k in range(count)]
            data = struct.pack(f">{count}H", *words)
            return bytes([slave, function, len(data)]) + data, {"gripper": "read", "at": address}
        words = list(struct.unpack(f">{count}H", request[7 : 7 + 2 * count]))
        asked = self._write(address, words)
        return request[:6], {"gripper": "write", "at": address} | asked

    def _read(self, address: int) -> int:
        position = round(self.position) & 0xFFFFFFFF
        if address == POSITION:
            return position >> 16
        if address == POSITION + 1:
            return position & 0xFFFF
        if address == STATUS:
            return int(self.moving)
        return self.registers.get(address, 0)

    def _write(self, address: int, words: list[int]) -> dict[str, object]:
        if address == TARGET:
            self.target = _signed(words)
            return {"target": self.target}
        if address == G2_MOTION:
            self.registers[ENABLE], self.registers[FORCE] = words[0], words[2]
            # The speed that the SDK sends is 0.4 * value - 140 in r/min, 9.88235 mm per turn.
            self._rate = max(0.0, words[1] * 0.4 - 140.0) * 9.88235 / 60.0 * 10.0
            self.target = _signed(words[3:])
            return {"target": self.target, "speed": words[1], "force": words[2]}
        if address == RESET_ERROR:
            self.registers[ERROR] = 0
        elif address == SPEED:
            self._rate = 0.4 * words[0]  # 2000 pulses/s at 5000 r/min
        self.registers[address] = words[0]
        return {"value": words[0]}


def _signed(words: list[int]) -> int:
    return struct.unpack(">i", struct.pack(">HH", *words[:2]))[0]


def g2_pulses(gap: float) -> float:
    """Pulses of G2 at a gap of the stock pads [mm]; the formula of the SDK."""
    return (math.degrees(math.asin((gap - 16.0) / 110.0)) + 8.33) * 18.28
