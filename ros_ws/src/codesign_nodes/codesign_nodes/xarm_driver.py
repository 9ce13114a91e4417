"""Node xarm_driver: a real xArm7 with its gripper on the topics of fem_simulator.

It refuses what the arm must not get, and moves nothing before `~/enable` (or `~/recover`) was
called and commands match the measured posture; see docs/driver.md. Times of commands are moved to
the steady clock, so that a jump of the wall clock is no motion.
"""

import sys
import threading
import time
from collections import deque
from typing import Any

import numpy as np
from codesign_interfaces.msg import FingerDesign, GripperCommand, GripperState, JointCommand
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from codesign_control.driver import (
    ClockMap,
    CommandRefused,
    DriverConfig,
    DriverState,
    GripperReading,
    LinkError,
    Measured,
    XarmDriver,
    lock_memory,
    prioritize_process,
)
from codesign_nodes import messages, qos
from codesign_nodes.mounted import mounted
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, nanoseconds, run, stamp_of

# SCHED_FIFO of the rest of the process, when realtime. Above the 10 that bring-up gives to others:
# equal ones do not take turns, and one of them that starts up would keep the interpreter's lock.
PROCESS_PRIORITY = 20
SWITCH_INTERVAL = 1e-4  # s after which a thread gives up the interpreter to the streaming one
NAMES = [f"joint{k}" for k in range(1, 8)]


class XarmDriverNode(LeanNode):
    """Wraps `XarmDriver`."""

    def __init__(self) -> None:
        super().__init__("xarm_driver")
        if self.get_parameter("use_sim_time").value:
            raise ValueError("use_sim_time: a real arm has no simulated time")
        config = self._declare_config()
        self._enables_at_start = declare(
            self,
            "enable_on_start",
            False,
            "enable motion at the first connection, as ~/enable would; never after a lost one",
        )
        self._deviations_file = declare(
            self,
            "deviations_file",
            "",
            "file for the lateness of every wake-up of the streaming thread [s], .npy, at the end",
        )
        self._clocks = ClockMap()
        self._commands = 0
        if config.realtime:
            sys.setswitchinterval(SWITCH_INTERVAL)
            self._process_fifo = prioritize_process(PROCESS_PRIORITY)
            self._memory_locked = lock_memory()
        else:
            sys.setswitchinterval(0.0005)
            self._process_fifo = self._memory_locked = False
        self._joint_pub = self.create_publisher(JointState, "/joint_states", qos.STATE_OFFERED)
        self._gripper_pub = self.create_publisher(GripperState, "/gripper_state", qos.STATE_OFFERED)
        self._driver = XarmDriver(config, self._publish_joints, self._publish_gripper)
        self.create_subscription(
            JointCommand, "/joint_command", self._on_joint_command, qos.JOINT_COMMAND_REQUESTED
        )
        self.create_subscription(
            GripperCommand,
            "/gripper_command",
            self._on_gripper_command,
            qos.GRIPPER_COMMAND_REQUESTED,
        )
        self.create_subscription(FingerDesign, "/finger_design", self._on_design, qos.LATCHED)
        # These take up to some seconds; in a group of their own they hold nothing else up.
        waiting = ReentrantCallbackGroup()
        self.create_service(SetBool, "~/enable", self._on_enable, callback_group=waiting)
        self.create_service(Trigger, "~/recover", self._on_recover, callback_group=waiting)
        self._answers: deque[tuple[Future, tuple[bool, str]]] = deque()
        self._answered = self.create_guard_condition(self._finish_calls)
        self._diagnostics = Diagnostics(self, self._report)
        self._driver.start()
        if self._enables_at_start:
            threading.Thread(target=self._enable_at_start, daemon=True).start()

    def _declare_config(self) -> DriverConfig:
        d = DriverConfig()
        return DriverConfig(
            address=declare(self, "address", d.address, "IPv4 address of the control box"),
            rate=declare(
                self, "rate", d.rate, "servo points [Hz]; 250 wants realtime", low=50, high=250
            ),
            realtime=declare(
                self, "realtime", d.realtime, "SCHED_FIFO for the whole process, where permitted"
            ),
            dry_run=declare(
                self, "dry_run", d.dry_run, "connect, read and report; enable and command nothing"
            ),
            gripper=declare(self, "gripper", d.gripper, "which one is mounted: g1, g2 or none"),
            joint_velocity=declare(
                self,
                "joint_velocity",
                d.joint_velocity,
                "faster commands are refused [rad/s]",
                low=0.05,
                high=3.14,
            ),
            command_timeout=declare(
                self,
                "command_timeout",
                d.command_timeout,
                "age of a command above which it counts no more [s]",
                low=0.03,
                high=0.5,
            ),
            match_tolerance=declare(
                self,
                "match_tolerance",
                d.match_tolerance,
                "largest difference of a first command to the measured posture [rad]",
                low=0.001,
                high=0.05,
            ),
            delay=declare(
                self,
                "command_delay",
                d.delay,
                "age at which a set-point goes out; jitter up to that stays out of the motion [s]",
                low=0.01,
                high=0.2,
            ),
            reply_patience=declare(
                self,
                "reply_patience",
                d.reply_patience,
                "time without a reply while streaming after which the box counts as hung [s]",
                low=0.01,
                high=1.0,
            ),
            report_timeout=declare(
                self,
                "report_timeout",
                d.report_timeout,
                "time without a report after which the connection counts as lost [s]",
                low=0.05,
                high=2.0,
            ),
            gripper_speed=declare(
                self,
                "gripper_speed",
                d.gripper_speed,
                "of the gap, where a command names none [m/s]",
                low=0.015,
                high=0.225,
            ),
            gripper_effort=declare(
                self,
                "gripper_effort",
                d.gripper_effort,
                "share of G2's largest force, where a command names none",
                low=0.01,
                high=1.0,
            ),
        )

    def close(self) -> None:
        """Stops streaming; the arm stays where it is."""
        self._driver.close()
        if self._deviations_file:
            np.save(self._deviations_file, self._driver.deviations())

    # --- states

    def _publish_joints(self, measured: Measured) -> None:
        if not self.context.ok():
            return
        message = JointState(
            name=NAMES, position=measured.position.tolist(), velocity=measured.velocity.tolist()
        )
        message.header.stamp = self._stamp_of(measured.moment)
        self._joint_pub.publish(message)

    def _publish_gripper(self, reading: GripperReading) -> None:
        if not self.context.ok():
            return
        message = GripperState(
            width=reading.width,
            velocity=reading.velocity,
            target_width=reading.target_width,
            drive_joint=reading.drive_joint,
            moving=reading.moving,
        )
        message.header.stamp = self._stamp_of(reading.moment)
        self._gripper_pub.publish(message)

    def _stamp_of(self, moment: float) -> Any:
        """ROS time of a moment of the steady clock [s], which is not long ago."""
        age = round((time.monotonic() - moment) * 1e9)
        return stamp_of(self.get_clock().now().nanoseconds - age)

    # --- commands

    def _on_joint_command(self, message: JointCommand) -> None:
        now = self.get_clock().now().nanoseconds
        moment = self._clocks.steady(nanoseconds(message.valid_at), now, time.monotonic_ns())
        self._commands += 1
        try:
            self._driver.command(np.array(message.position), moment)
        except CommandRefused as refusal:
            self._log_refusal(refusal)

    def _on_gripper_command(self, message: GripperCommand) -> None:
        try:
            self._driver.command_gripper(message.width, message.speed, message.effort)
        except CommandRefused as refusal:
            self._log_refusal(refusal)

    def _log_refusal(self, refusal: CommandRefused) -> None:
        self.get_logger().warning(f"refused: {refusal}", throttle_duration_sec=1.0)

    def _on_design(self, message: FingerDesign) -> None:
        try:
            self._driver.mount(mounted(messages.design_from(message)))
        except ValueError as error:
            self.get_logger().warning(f"finger design refused: {error}")

    # --- services

    async def _on_enable(
        self, request: SetBool.Request, response: SetBool.Response
    ) -> SetBool.Response:
        call = self._driver.enable if request.data else self._disable
        response.success, response.message = await self._in_thread(call)
        return response

    async def _on_recover(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = await self._in_thread(self._driver.recover)
        return response

    def _disable(self) -> str:
        self._driver.disable()
        return "disabled"

    async def _in_thread(self, call: Any) -> tuple[bool, str]:
        """What a call that waits for the arm says; meanwhile the executor goes on."""
        future = Future()

        def work() -> None:
            try:
                answer = (True, call())
            except LinkError as error:
                answer = (False, str(error))
            except Exception as error:
                answer = (False, f"{type(error).__name__}: {error}")
            self._answers.append((future, answer))
            self._answered.trigger()

        threading.Thread(target=work, daemon=True).start()
        return await future

    def _finish_calls(self) -> None:
        """In a turn of the executor: a future that another thread sets does not wake it."""
        while self._answers:
            future, answer = self._answers.popleft()
            future.set_result(answer)

    def _enable_at_start(self) -> None:
        while self._driver.state is DriverState.DISCONNECTED:
            if not self.context.ok():
                return
            time.sleep(0.05)
        try:
            self.get_logger().info(self._driver.enable())
        except LinkError as error:
            self.get_logger().error(f"not enabled: {error}")

    # --- diagnostics

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        status = self._driver.status()
        level = {
            DriverState.DISCONNECTED: DiagnosticStatus.ERROR,
            DriverState.FAULT: DiagnosticStatus.ERROR,
            DriverState.MATCHING: DiagnosticStatus.WARN,
            DriverState.DISABLED: DiagnosticStatus.WARN,
        }.get(status.state, DiagnosticStatus.OK)
        if level == DiagnosticStatus.OK and (status.gripper_message or status.warning):
            level = DiagnosticStatus.WARN
        message = f"{status.state.name.lower()}: {status.message}"
        if status.gripper_message:
            message += f"; {status.gripper_message}"
        return level, message, {
            "state": status.state.name.lower(),
            "mode": status.mode,
            "arm_state": status.arm_state,
            "error": status.error,
            "warning": status.warning,
            "firmware": status.firmware,
            "dry_run": self._driver.config.dry_run,
            "connections": status.connections,
            "commands_received": self._commands,
            "points_sent": status.points_sent,
            "points_held": status.points_held,
            "pauses": status.pauses,
            **{f"refused_{reason}": count for reason, count in status.refused.items()},
            "last_refusal": status.last_refusal,
            "replies_late": status.replies_late,
            "ticks_missed": status.ticks_missed,
            "deviation_p50_ms": round(status.deviation.p50, 3),
            "deviation_p99_ms": round(status.deviation.p99, 3),
            "deviation_max_ms": round(status.deviation.max, 3),
            "sched_fifo": status.fifo,
            "process_fifo": self._process_fifo,
            "memory_locked": self._memory_locked,
            "clock_jumps": self._clocks.jumps,
            "gripper_commands": status.gripper_commands,
            "gripper_port": 503 if status.own_gripper_port else 502,
        }  # fmt: skip


def main() -> None:
    """Runs the node."""
    run(XarmDriverNode)
