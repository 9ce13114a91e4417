"""Driver of a real xArm7 with its gripper, over UFACTORY's SDK. No ROS."""

from codesign_control.driver.arm_link import LinkError
from codesign_control.driver.clock_map import ClockMap
from codesign_control.driver.command_checks import REASONS, CommandChecks, CommandRefused
from codesign_control.driver.command_stream import CommandStream, Measured
from codesign_control.driver.config import DriverConfig
from codesign_control.driver.deadline_loop import (
    DeadlineLoop,
    Deviation,
    lock_memory,
    prioritize,
    prioritize_process,
)
from codesign_control.driver.driver import DriverState, DriverStatus, XarmDriver
from codesign_control.driver.gripper import GripperReading

__all__ = [
    "REASONS",
    "ClockMap",
    "CommandChecks",
    "CommandRefused",
    "CommandStream",
    "DeadlineLoop",
    "Deviation",
    "DriverConfig",
    "DriverState",
    "DriverStatus",
    "GripperReading",
    "LinkError",
    "Measured",
    "XarmDriver",
    "lock_memory",
    "prioritize",
    "prioritize_process",
]
