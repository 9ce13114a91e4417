"""The driver of a real xArm7: commands in, states out, and nothing on the wire that is not checked.

Three threads of its own: servo points at absolute deadlines; the gripper; and one that connects,
looks at errors and connects again. The SDK adds its own.
"""

from __future__ import annotations

import contextlib
import enum
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from codesign_control.driver.arm_link import (
    SERVO_MODE,
    STOPPED_STATES,
    ArmLink,
    LinkError,
    Reply,
    describe,
)
from codesign_control.driver.command_checks import CommandRefused
from codesign_control.driver.command_stream import CommandStream, Measured
from codesign_control.driver.config import DriverConfig
from codesign_control.driver.deadline_loop import DeadlineLoop, Deviation, prioritize
from codesign_control.driver.gripper import GripperReading, GripperThread
from codesign_control.gripper import GripperModel

VELOCITY_REPORTS = 6  # over which the measured velocity is the slope; 50 ms at 100 Hz
HELPER_PRIORITY = 30  # SCHED_FIFO of the threads that the streaming one waits for
LOOK_TIMEOUT = 0.1  # s, of a look at the error codes; the supervisor has more to do
POLL_PERIOD = 0.5  # s between looks at error codes that no reply announced


class DriverState(enum.IntEnum):
    """Where the driver is."""

    DISCONNECTED = 0  # no control box; trying
    DISABLED = 1  # connected, reporting; wants `enable`
    MATCHING = 2  # in servo mode; waits for commands that match where the arm is
    STREAMING = 3
    FAULT = 4  # an error of the arm; wants `recover`


@dataclass(frozen=True)
class DriverStatus:
    """What there is to know about a driver at one moment."""

    state: DriverState
    message: str
    mode: int
    arm_state: int
    error: int
    warning: int
    firmware: str
    points_sent: int
    points_held: int  # refused by the last look before the SDK
    replies_late: int
    connections: int
    pauses: int
    refused: dict[str, int]
    last_refusal: str
    ticks_missed: int
    fifo: bool
    deviation: Deviation
    gripper_message: str
    gripper_commands: int
    own_gripper_port: bool


class XarmDriver:
    """Streams joint commands to one arm and gripper.

    Args:
        on_joints, on_gripper: called for each report of the arm and each reading of the gripper,
            in threads of the driver; they must be quick.
        clock: steady [s]; make_link: makes a connection. Others than these only where time and arm
            are simulated.

    All times are of that clock [s]. Methods may be called from any thread.
    """

    def __init__(
        self,
        config: DriverConfig,
        on_joints: Callable[[Measured], None] = lambda _: None,
        on_gripper: Callable[[GripperReading], None] = lambda _: None,
        *,
        clock: Callable[[], float] = time.monotonic,
        make_link: Callable[[DriverConfig, Callable[[np.ndarray], None]], ArmLink] = ArmLink,
    ) -> None:
        self.config = config
        self._clock, self._make_link = clock, make_link
        self._on_joints = on_joints
        self._stream = CommandStream(config)
        self._gripper = GripperThread(config, on_gripper)
        self._loop = DeadlineLoop(config.period, self._tick, realtime=config.realtime)
        self._state = DriverState.DISCONNECTED
        self._message = "starting"
        self._link: ArmLink | None = None
        self._measured: Measured | None = None
        self._reports: deque[tuple[float, np.ndarray]] = deque(maxlen=VELOCITY_REPORTS)
        self._reply_at = 0.0
        self._points_sent = self._late = 0
        self._connections = 0
        self._error = self._warning = 0
        self._looked_at = self._linked_at = 0.0
        # Changes of state: by the streaming thread, the supervisor and callers of `enable`.
        self._lock = threading.RLock()
        self._one_recovery = threading.Lock()
        self._attention = threading.Event()
        self._closing = threading.Event()
        self._supervisor = threading.Thread(target=self._supervise, name="arm", daemon=True)

    # --- life

    def start(self) -> None:
        """Starts connecting, and goes on doing so until `close`."""
        self._gripper.start()
        self._loop.start()
        self._supervisor.start()

    def close(self) -> None:
        """Stops streaming and disconnects; the arm stays where it is, enabled as it was."""
        self._closing.set()
        self._attention.set()
        self._loop.stop()
        self._gripper.stop()
        link = self._link
        if link is not None:
            link.close()
        self._supervisor.join(2.0)

    def __enter__(self) -> XarmDriver:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- what callers ask and tell

    @property
    def state(self) -> DriverState:
        return self._state

    @property
    def measured(self) -> Measured | None:
        """The newest posture; None before the first report of a connection."""
        return self._measured

    def deviations(self) -> np.ndarray:
        """Lateness of the streaming thread's wake-ups [s], in order."""
        return self._loop.deviations()

    def status(self) -> DriverStatus:
        """Everything at this moment."""
        link = self._link
        return DriverStatus(
            state=self._state,
            message=self._message,
            mode=link.mode if link else -1,
            arm_state=link.state if link else -1,
            error=self._error,
            warning=self._warning,
            firmware=link.version if link else "",
            points_sent=self._points_sent,
            points_held=self._stream.held,
            replies_late=self._late,
            connections=self._connections,
            pauses=self._stream.pauses,
            refused=dict(self._stream.checks.refused),
            last_refusal=self._stream.checks.last_refusal,
            ticks_missed=self._loop.missed,
            fifo=self._loop.fifo,
            deviation=self._loop.deviation(last=self.config.rate * 10),
            gripper_message=self._gripper.message,
            gripper_commands=self._gripper.commands_sent,
            own_gripper_port=bool(link and link.own_gripper_port),
        )

    def command(self, position: object, moment: float) -> None:
        """Takes a set-point (7,) [rad] that is meant for a moment of the steady clock [s].

        Raises:
            CommandRefused: it goes no further; counted by its reason.
        """
        self._stream.command(position, moment, self._clock())

    def command_gripper(self, width: float, speed: float = 0.0, effort: float = 0.0) -> None:
        """Takes a target of the gripper: gap [m], speed [m/s], share of the largest force.

        Raises:
            CommandRefused: it goes no further; counted by its reason.
        """
        try:
            self._gripper.command(width, speed, effort)
        except CommandRefused as refusal:
            self._stream.checks.count(refusal)
            raise

    def mount(self, model: GripperModel) -> None:
        """Tells which fingers the gaps are of."""
        self._gripper.mount(model)

    def enable(self) -> str:
        """Enables the motors and waits for matching commands; says what comes next.

        Raises:
            LinkError: not connected, an error to be cleared by `recover`, a dry run.
        """
        return self._bring_up(clear=False)

    def recover(self) -> str:
        """Clears errors and warnings, then as `enable`. Nothing moves before commands match again.

        Raises:
            LinkError: not connected, an error whose cause is still there, a dry run.
        """
        return self._bring_up(clear=True)

    def disable(self) -> None:
        """Stops the arm (its state 4), which holds its posture; the gripper gets no targets."""
        with self._lock:
            if self._state is DriverState.DISCONNECTED:
                return
            self._enter(DriverState.DISABLED, "disabled, call enable")
            link = self._link
        if link is not None and not self.config.dry_run:
            link.patience(self.config.call_timeout)
            link.stop()

    def _bring_up(self, *, clear: bool) -> str:
        if self.config.dry_run:
            raise LinkError("dry run: motion stays disabled; start without dry_run to move")
        with self._one_recovery:
            with self._lock:
                link = self._link
                if link is None or self._state is DriverState.DISCONNECTED:
                    raise LinkError(f"not connected: {self._message}")
                if not clear and self._state in (DriverState.MATCHING, DriverState.STREAMING):
                    return "enabled already"
                # Nothing is streamed while modes change.
                self._enter(DriverState.DISABLED, "enabling")
            try:
                link.patience(self.config.call_timeout)
                if clear:
                    link.clear()
                self._error, self._warning = link.errors()
                if self._error:
                    raise LinkError(f"{describe(self._error)}: call recover")
                link.enable()
                if self.config.gripper != "none":
                    link.enable_gripper()
                link.patience_while_streaming()
            except LinkError as error:
                self._fail_bring_up(link, str(error))
                raise
            with self._lock:
                if link is not self._link:
                    raise LinkError("the connection was lost meanwhile")
                self._enter(DriverState.MATCHING, "waiting for commands that match the posture")
            return "enabled: moves once commands match the measured posture"

    def _fail_bring_up(self, link: ArmLink, message: str) -> None:
        with contextlib.suppress(LinkError):
            self._error, self._warning = link.errors()
        with self._lock:
            if link is self._link:
                state = DriverState.FAULT if self._error else DriverState.DISABLED
                self._enter(state, message)

    # --- state

    def _enter(self, state: DriverState, message: str) -> None:
        """Changes the state; only with the lock held."""
        if state is not DriverState.STREAMING:
            self._stream.reset(message)
        self._state, self._message = state, message
        self._gripper.allow(state in (DriverState.MATCHING, DriverState.STREAMING))

    def _fault(self, message: str) -> None:
        """An error of the arm: latched until `recover`."""
        with self._lock:
            if self._state in (DriverState.MATCHING, DriverState.STREAMING, DriverState.DISABLED):
                self._enter(DriverState.FAULT, message)
        self._looked_at = 0.0
        self._attention.set()

    # --- reports of the arm

    def _take_report(self, link: ArmLink, joints: np.ndarray) -> None:
        if link is not self._link or not np.isfinite(joints).all():
            return
        now = self._clock()
        self._reports.append((now, joints))
        self._measured = Measured(now, joints, self._slope())
        self._on_joints(self._measured)

    def _slope(self) -> np.ndarray:
        """Velocity over the last reports [rad/s], by least squares."""
        if len(self._reports) < 3:
            return np.zeros(7)
        times = np.array([t for t, _ in self._reports])
        times -= times.mean()
        return times @ np.array([q for _, q in self._reports]) / (times @ times)

    # --- streaming thread

    def _tick(self, now: float) -> None:
        link = self._link
        if link is None or self._state not in (DriverState.MATCHING, DriverState.STREAMING):
            return
        if link.mode != SERVO_MODE or link.state in STOPPED_STATES:
            self._fault(f"the arm left servo mode: mode {link.mode}, state {link.state}; recover")
            return
        # Whoever changes the state waits for this lock before it talks to the arm.
        with self._lock:
            was = self._state
            if was not in (DriverState.MATCHING, DriverState.STREAMING) or link is not self._link:
                return
            point = self._stream.tick(now, self._measured)
            if self._stream.playing and was is DriverState.MATCHING:
                self._reply_at = now
            self._state = DriverState.STREAMING if self._stream.playing else DriverState.MATCHING
            self._message = self._stream.message
            if point is None:
                return
            reply = link.servo(point)
            self._points_sent += 1
        self._judge(reply, now)

    def _judge(self, reply: Reply, now: float) -> None:
        if reply is Reply.DONE:
            self._reply_at = now
        elif reply is Reply.LATE:
            self._late += 1
            self._judge_silence(now)
        elif reply is Reply.ERROR:
            self._fault("the arm reports an error; recover")
        elif reply is Reply.LOST:
            self._attention.set()
        else:
            self._fault(f"{reply.value}; recover")

    def _judge_silence(self, now: float) -> None:
        """Late replies alone may be a slow network; without reports too, the box hangs."""
        config = self.config
        unanswered = now - self._reply_at
        last = self._measured.moment if self._measured else 0.0
        if unanswered > config.reply_patience and now - last > config.reply_patience:
            self._fault(f"the control box hangs: silent for {(now - last) * 1e3:.0f} ms; recover")
        elif unanswered > config.answer_timeout:
            self._fault(
                f"the control box reports, but answers no command within "
                f"{config.reply_share * config.period * 1e3:.1f} ms; recover"
            )

    # --- the thread that connects

    def _supervise(self) -> None:
        if self.config.realtime:  # the SDK's threads inherit it: replies come in time
            prioritize(threading.get_native_id(), HELPER_PRIORITY)
        while not self._closing.is_set():
            if self._link is None:
                self._connect()
                if self._link is None:
                    self._closing.wait(self.config.reconnect_period)
                continue
            asked, period = time.monotonic(), min(POLL_PERIOD, self.config.report_timeout / 4.0)
            self._attention.wait(period)
            self._attention.clear()
            if time.monotonic() - asked > 2.0 * period:
                # This process stood still: reports that came meanwhile wait to be taken in.
                self._closing.wait(period)
            if self._closing.is_set():
                return
            self._look_after(self._link)

    def _connect(self) -> None:
        self._reports.clear()
        self._measured = None
        link = self._make_link(self.config, lambda joints: self._take_report(link, joints))
        try:
            link.connect()
            self._error, self._warning = link.errors()
        except LinkError as error:
            self._message = str(error)
            link.close()
            return
        if self._closing.is_set():
            link.close()
            return
        with self._lock:
            self._link = link
            self._connections += 1
            self._linked_at = self._clock()
            message = "connected, call enable"
            if self.config.dry_run:
                message = "connected, dry run: motion stays disabled"
            if self._error:
                self._enter(DriverState.FAULT, f"{describe(self._error)}; recover")
            else:
                self._enter(DriverState.DISABLED, message)
        if self.config.gripper != "none":
            self._gripper.attach(link)

    def _look_after(self, link: ArmLink) -> None:
        """Drops a dead connection; finds out what an error is."""
        last = self._measured.moment if self._measured else self._linked_at
        silent = self._clock() - last
        if not link.connected or silent > self.config.report_timeout:
            why = "closed" if not link.connected else f"silent for {silent:.2f} s"
            self._drop(
                link, f"connection to {self.config.address} {why}; enable anew once it is back"
            )
            return
        # While streaming the replies tell at once; a look would only hold up a servo point.
        if self._state is DriverState.STREAMING or self._one_recovery.locked():
            return
        self._look_at_errors(link)

    def _look_at_errors(self, link: ArmLink) -> None:
        now = self._clock()
        if now - self._looked_at < POLL_PERIOD:
            return
        self._looked_at = now
        if self._state in (DriverState.FAULT, DriverState.DISABLED):
            link.patience(LOOK_TIMEOUT)
        try:
            error, warning = link.errors()
        except LinkError:
            return  # reports decide whether the connection is dead
        with self._lock:
            if link is not self._link:
                return
            changed = error != self._error
            self._error, self._warning = error, warning
            if error and (changed or self._state is not DriverState.FAULT):
                self._enter(DriverState.FAULT, f"{describe(error)}; recover")

    def _drop(self, link: ArmLink, message: str) -> None:
        with self._lock:
            self._link = None
            self._enter(DriverState.DISCONNECTED, message)
        self._gripper.attach(None)
        link.close()
