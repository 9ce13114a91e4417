"""The gripper in a thread of its own: its bus is slow, and must not hold up servo points."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from codesign_control.driver.arm_link import ArmLink, LinkError
from codesign_control.driver.command_checks import CommandRefused
from codesign_control.driver.config import DriverConfig
from codesign_control.gripper import (
    DRIVE_LIMIT,
    G1,
    G2,
    STOCK_PROTRUSION,
    GripperModel,
)

RETRY_PERIOD = 0.5  # s between readings of a gripper that does not answer
MOVING_SPEED = 0.001  # m/s of the gap, the resolution of a reading at 20 Hz is 0.002
G1_TURNS = 5000.0  # r/min, the largest speed of G1, taken as its largest speed of the gap
G1_LEAST_TURNS = 1000.0
SMALLEST_CHANGE = 5e-5  # m; a target nearer to the last one is the same


@dataclass(frozen=True)
class GripperReading:
    """What the gripper says: gap [m] between the fingers' most protruding points.

    Attributes:
        moment: steady clock [s].
        width, target_width: [m]; velocity: of the width [m/s]; drive_joint: [rad].
    """

    moment: float
    width: float
    velocity: float
    target_width: float
    drive_joint: float
    moving: bool


class GripperG1:
    """Pulses are linear in the drive joint: 850 open, 0 closed (xarm_ros2 `xarm_control`)."""

    spec = G1

    def __init__(self, model: GripperModel) -> None:
        self.model = model

    def width(self, pulses: float) -> float:
        """Gap [m] at a position [pulses]."""
        joint = min(max(DRIVE_LIMIT - pulses * 1e-3, 0.0), DRIVE_LIMIT)
        return self.model.clip(self.model.width_of(joint))

    def pulses(self, width: float) -> float:
        """Position [pulses] at a gap [m]."""
        return (DRIVE_LIMIT - self.model.drive_joint(self.model.clip(width))) * 1e3

    def move(self, link: ArmLink, width: float, speed: float, _effort: float) -> None:
        """To a gap [m] at a speed of the gap [m/s]; it has no force to set."""
        turns = min(max(speed / self.spec.max_speed * G1_TURNS, G1_LEAST_TURNS), G1_TURNS)
        link.move_g1(self.pulses(width), turns)


class GripperG2:
    """The SDK's own curve: gap of the stock pads [mm] = 110 sin(pulses / 18.28 - 8.33 deg) + 16."""

    spec = G2

    def __init__(self, model: GripperModel) -> None:
        self.model = model
        self._deeper = 2.0 * (model.protrusion - STOCK_PROTRUSION)  # m, than the stock pads

    def width(self, pulses: float) -> float:
        """Gap [m] at a position [pulses]."""
        gap = 110.0 * math.sin(math.radians(pulses / 18.28 - 8.33)) + 16.0
        return self.model.clip(gap * 1e-3 - self._deeper)

    def move(self, link: ArmLink, width: float, speed: float, effort: float) -> None:
        """To a gap [m] at a speed of the gap [m/s] with a share of the largest force."""
        gap = (self.model.clip(width) + self._deeper) * 1e3
        speed = min(max(speed, self.spec.min_speed), self.spec.max_speed)
        # Half a pulse more: the SDK rounds down.
        link.move_g2(min(max(gap + 0.05, 0.0), 84.0), speed * 1e3, max(1.0, effort * 100.0))


Target = tuple[float, float, float]  # gap [m], speed of the gap [m/s], share of the largest force


class GripperThread:
    """Reads at its rate, and sends the newest target where that has changed.

    Targets wait as long as the arm's set-points do: closing fingers move forward, and the arm has
    to have made room for them by then.

    Args:
        on_reading: called with every reading, in this thread.

    Attributes:
        message: what is wrong with the gripper; empty: nothing.
    """

    def __init__(self, config: DriverConfig, on_reading: Callable[[GripperReading], None]) -> None:
        self._config = config
        self._on_reading = on_reading
        self._link: ArmLink | None = None
        self._allowed = False
        self._targets: deque[tuple[float, Target]] = deque(maxlen=64)  # with the moments to go at
        self._wanted: Target | None = None
        self._sent: float | None = None
        self._kind = self._make_kind(GripperModel())
        self._last: tuple[GripperG1 | GripperG2, GripperReading] | None = None
        self._stop = threading.Event()
        self.message = ""
        self.commands_sent = 0
        self.errors = 0
        self._thread = threading.Thread(target=self._run, name="gripper", daemon=True)

    def _make_kind(self, model: GripperModel) -> GripperG1 | GripperG2:
        return GripperG1(model) if self._config.gripper == "g1" else GripperG2(model)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ends it."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(2.0)

    def mount(self, model: GripperModel) -> None:
        """Other fingers: gaps are theirs from now on; a target is only taken anew."""
        self._forget()
        self._kind = self._make_kind(model)

    def attach(self, link: ArmLink | None) -> None:
        """A new connection, or none: nothing is sent until `allow`."""
        self._allowed = False
        self._forget()
        self._link = link

    def allow(self, allowed: bool) -> None:
        """Whether targets are sent; what was wanted before counts no more."""
        if allowed != self._allowed:
            self._forget()
        self._allowed = allowed and not self._config.dry_run

    def _forget(self) -> None:
        self._targets.clear()
        self._wanted = self._sent = None

    def command(self, width: float, speed: float, effort: float) -> None:
        """Takes a target: gap [m], speed of the gap [m/s], share of the largest force.

        0 for speed or effort: the configured one.

        Raises:
            CommandRefused: a value is not finite or makes no sense.
        """
        if not all(math.isfinite(v) for v in (width, speed, effort)):
            raise CommandRefused(
                "not_finite", f"gripper command: not finite: {width}, {speed}, {effort}"
            )
        if not -0.001 <= width <= 0.2:
            raise CommandRefused("outside_limits", f"gripper width {width} m: must be 0..0.2 m")
        if speed < 0.0 or not 0.0 <= effort <= 1.0:
            raise CommandRefused(
                "outside_limits",
                f"gripper speed {speed} m/s, effort {effort}: must be 0 or more, and 0..1",
            )
        target = (
            self._kind.model.clip(width),
            speed or self._config.gripper_speed,
            effort or self._config.gripper_effort,
        )
        self._targets.append((time.monotonic() + self._config.delay, target))

    def _run(self) -> None:
        period = 1.0 / self._config.gripper_rate
        due = time.monotonic()
        while not self._stop.is_set():
            due = max(due + period, time.monotonic())
            link = self._link
            if link is not None:
                try:
                    self._turn(link)
                    self.message = ""
                except LinkError as error:
                    self.errors += 1
                    self.message = self._what_is_wrong(link, str(error))
                    self._stop.wait(RETRY_PERIOD)
            self._stop.wait(max(0.0, due - time.monotonic()))

    def _turn(self, link: ArmLink) -> None:
        kind = self._kind  # `mount` may come at any moment: one of them throughout
        while self._targets and self._targets[0][0] <= time.monotonic():
            self._wanted = self._targets.popleft()[1]
        wanted = self._wanted
        changed = wanted is not None and (
            self._sent is None or abs(wanted[0] - self._sent) >= SMALLEST_CHANGE
        )
        if changed and self._allowed and link is self._link:
            assert wanted is not None
            kind.move(link, *wanted)
            self._sent = wanted[0]
            self.commands_sent += 1
        self._read(link, kind)

    def _read(self, link: ArmLink, kind: GripperG1 | GripperG2) -> None:
        width = kind.width(link.gripper_pulses())
        now = time.monotonic()
        velocity = 0.0
        if self._last is not None and self._last[0] is kind:  # else: other fingers, no motion
            velocity = (width - self._last[1].width) / (now - self._last[1].moment)
        reading = GripperReading(
            moment=now,
            width=width,
            velocity=velocity,
            target_width=width if self._sent is None else self._sent,
            drive_joint=kind.model.drive_joint(width),
            moving=abs(velocity) > MOVING_SPEED,
        )
        self._last = kind, reading
        self._on_reading(reading)

    def _what_is_wrong(self, link: ArmLink, message: str) -> str:
        with contextlib.suppress(LinkError):
            error = link.gripper_error()
            if error:
                return f"gripper error G{error}: recover"
        return message
