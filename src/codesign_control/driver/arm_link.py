"""The arm as UFACTORY's SDK gives it: the only module that knows `xarm`."""

from __future__ import annotations

import contextlib
import enum
import importlib
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from codesign_control.driver.config import DriverConfig

POSITION_MODE, SERVO_MODE = 0, 1
STOPPED_STATES = (3, 4, 5, 6)  # of reports: paused, stopped, just reset, ...
SERVO_SPEED, SERVO_ACCELERATION = 1.0, 10.0  # rad/s, rad/s^2; servo mode 1 does not use them
SETTLE_TIME = 0.1  # s between a change of mode or state and the next call
# Codes of the SDK's calls (x3/code.py).
_ERROR, _WARNING, _TIMEOUT, _NOT_READY, _NOT_CONNECTED = 1, 2, 3, 9, (-1, 8)


class LinkError(RuntimeError):
    """The control box is not there, or refuses; the message says what to do."""


class Reply(enum.Enum):
    """What became of a servo point."""

    DONE = "done"
    LATE = "no reply in time"
    ERROR = "the arm reports an error"
    NOT_READY = "the arm is not ready to move"
    LOST = "connection lost"
    REFUSED = "refused by the SDK"


class ArmLink:
    """One connection to a control box; a new object for the next one.

    Args:
        on_report: called with joints (7,) [rad] for each report, in a thread of the SDK.

    Calls block until the reply is there, or for the time set by `patience`; they share a lock.
    """

    def __init__(self, config: DriverConfig, on_report: Callable[[np.ndarray], None]) -> None:
        self._config = config
        self._on_report = on_report
        sdk = _load_sdk()
        # Calls while it connects, and the gripper's on its own port, use the defaults.
        sdk.XCONF.UxbusConf.GET_TIMEOUT = sdk.XCONF.UxbusConf.SET_TIMEOUT = round(
            config.call_timeout * 1e3
        )
        self._api = sdk.XArmAPI(
            config.address,
            is_radian=True,
            do_not_open=True,
            forbid_uds=True,  # or a socket file in /tmp would win over the address
            report_type="real",  # 100 Hz
            check_is_pause=False,  # a gripper call would wait for the end of a pause, for ever
            check_cmdnum_limit=False,
            baud_checkset=False,  # looking at the gripper must not reboot the tool's interface
        )
        self._api.register_report_callback(self._report, report_cartesian=False)
        self.own_gripper_port = False

    # --- connection

    def connect(self) -> None:
        """Connects; returns once reports can come.

        Raises:
            LinkError: nobody answers.
        """
        try:
            self._api.connect()
        except Exception as error:  # the SDK raises plain Exception
            raise LinkError(
                f"no control box answers at {self._config.address}: {error}; is it on, and in "
                "this computer's network?"
            ) from error
        if not self.connected:
            raise LinkError(f"{self._config.address}: the connection was closed at once")
        if self._config.gripper != "none":
            # Firmware from 1.11 on: the gripper's slow bus does not hold up servo points.
            self.own_gripper_port = self._api.set_rs485_use_503_port(True) == 0

    def close(self) -> None:
        """Closes the connection, without waiting for the SDK's threads."""
        threading.Thread(target=self._disconnect, daemon=True).start()

    def _disconnect(self) -> None:
        with contextlib.suppress(Exception):
            self._api.disconnect()

    @property
    def connected(self) -> bool:
        return bool(self._api.connected)

    @property
    def mode(self) -> int:
        """Of the last report: 1 is servo mode."""
        return self._api.mode

    @property
    def state(self) -> int:
        """Of the last report: 1 moving, 2 ready, 3 paused, 4 stopped, 5 reset."""
        return self._api.state

    @property
    def version(self) -> str:
        """Of the firmware."""
        return ".".join(str(n) for n in self._api.version_number)

    def _report(self, report: dict[str, Any]) -> None:
        joints = report["joints"]
        if 0 < self._api.error_code <= 17:  # the SDK lets the posture stand then
            joints = self._api.report_data.actual_joint_angle
        self._on_report(np.array(joints[:7], dtype=float))

    # --- servo points

    def patience(self, seconds: float) -> None:
        """Sets how long calls wait."""
        self._api.set_timeout(seconds)

    def patience_while_streaming(self) -> None:
        """Calls wait less than a period."""
        config = self._config
        own = config.reply_share * config.period
        if self.own_gripper_port or config.gripper == "none":
            self._api.set_timeout(own)
        else:  # the gripper's replies come over the same connection, and take longer
            self._api.set_timeout([own, 0.1])

    def servo(self, joints: np.ndarray) -> Reply:
        """Sends one servo point (7,) [rad] that has been checked, and waits for its reply."""
        code = self._api.set_servo_angle_j(
            joints.tolist(), speed=SERVO_SPEED, mvacc=SERVO_ACCELERATION, mvtime=0
        )
        if code in (0, _WARNING):
            return Reply.DONE
        if code == _ERROR:
            return Reply.ERROR
        if code == _NOT_READY:
            return Reply.NOT_READY
        if code in _NOT_CONNECTED:
            return Reply.LOST
        return Reply.LATE if 3 <= code <= 7 else Reply.REFUSED

    # --- errors, enabling

    def errors(self) -> tuple[int, int]:
        """Error and warning code of the arm, 0 for none.

        Raises:
            LinkError: no answer.
        """
        code, codes = self._api.get_err_warn_code()
        if code not in (0, _ERROR, _WARNING):
            raise LinkError(f"the control box does not answer (code {code})")
        return int(codes[0]), int(codes[1])

    def clear(self) -> None:
        """Clears errors and warnings; LinkError when one stays."""
        self._api.clean_error()
        self._api.clean_warn()
        error, _ = self.errors()
        if error:
            raise LinkError(f"{describe(error)} is still there: remove its cause, then recover")

    def enable(self) -> None:
        """Enables the motors and goes to servo mode.

        Raises:
            LinkError: not done within the time that takes.
        """
        self._demand("motion_enable", self._api.motion_enable(True))
        self._demand("set_mode", self._api.set_mode(SERVO_MODE))
        self._demand("set_state", self._api.set_state(0))
        deadline = time.monotonic() + self._config.call_timeout + SETTLE_TIME
        while self.mode != SERVO_MODE or self.state in STOPPED_STATES:
            if time.monotonic() > deadline:
                error, _ = self.errors()
                raise LinkError(
                    f"the arm stays in mode {self.mode}, state {self.state}"
                    + (f": {describe(error)}" if error else "")
                )
            time.sleep(0.01)
        time.sleep(SETTLE_TIME)

    def stop(self) -> None:
        """Stops the arm: state 4. Brakes only where it is disabled by its owner."""
        self._api.set_state(4)

    def _demand(self, call: str, code: int) -> None:
        if code not in (0, _WARNING):
            raise LinkError(f"{call} failed with code {code}")

    # --- gripper, in units of the SDK

    def gripper_pulses(self) -> float:
        """Its position [pulses].

        Raises:
            LinkError: no answer, or an error of the gripper.
        """
        answer = self._api.get_gripper_position(check_baud=False)
        code, pulses = answer if isinstance(answer, tuple) else (answer, None)
        if code != 0 or pulses is None:
            raise LinkError(f"the gripper does not tell its position (code {code})")
        return float(pulses)

    def gripper_error(self) -> int:
        """Its error code, 0 for none; LinkError when it does not answer."""
        code, error = self._api.get_gripper_err_code(check_baud=False)
        if code != 0:
            raise LinkError(f"the gripper does not answer (code {code})")
        return int(error)

    def enable_gripper(self) -> None:
        """Clears its errors and enables it; may set the tool's baud rate.

        Raises:
            LinkError: it refuses.
        """
        api = self._api
        api.set_baud_checkset_enable(True)
        try:
            api.clean_gripper_error()
            for name, call in (("enable", api.set_gripper_enable), ("mode", api.set_gripper_mode)):
                code = call(name == "enable")  # position mode is 0
                if code != 0:
                    raise LinkError(f"set_gripper_{name} failed with code {code}")
        finally:
            api.set_baud_checkset_enable(False)

    def move_g1(self, pulses: float, turns: float) -> None:
        """G1: to a position [pulses] at a motor speed [r/min]; LinkError when it refuses."""
        code = self._api.set_gripper_position(
            round(pulses), speed=round(turns), wait=False, wait_motion=False, check_baud=False
        )
        if code != 0:
            raise LinkError(f"set_gripper_position failed with code {code}")

    def move_g2(self, gap: float, speed: float, force: float) -> None:
        """G2: to a gap of the stock pads [mm] at [mm/s], force 1..100 [%]; LinkError."""
        code = self._api.set_gripper_g2_position(
            gap, speed=speed, force=round(force), wait=False, wait_motion=False, check_baud=False
        )
        if code != 0:
            raise LinkError(f"set_gripper_g2_position failed with code {code}")


def describe(error: int) -> str:
    """An error code of the arm in the SDK's words."""
    codes = importlib.import_module("xarm.core.config.x_code").ControllerErrorCodeMap
    return f"C{error} ({codes.get(error, {}).get('en', {}).get('title', 'unknown error')})"


class _Sdk:
    """What is used of the SDK, imported on first use: it prints, and makes a folder for logs."""

    def __init__(self) -> None:
        self.XArmAPI: Any = importlib.import_module("xarm.wrapper").XArmAPI
        self.XCONF: Any = importlib.import_module("xarm.core.config.x_config").XCONF
        # Every code is looked at here and reported once; the SDK's own lines say it at each call.
        importlib.import_module("xarm.core.utils.log").logger.setLevel(logging.CRITICAL)


_sdk: list[_Sdk] = []


def _load_sdk() -> _Sdk:
    if not _sdk:
        _sdk.append(_Sdk())
    return _sdk[0]
