"""Measures how well xarm_driver keeps its deadlines while it streams, beside whatever runs here.

    python -m codesign_bringup.servo_bench --address 127.0.0.7 --rate 250 --realtime --out a.json

Starts the driver on topics of its own, enables it, and lets it follow a slow wave for a while. The
arm at the address MOVES: it is meant for the fake control box, and refuses other addresses.
Exit codes: 0 measured, 1 the driver did not stream.
"""

import argparse
import json
import math
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from codesign_interfaces.msg import JointCommand
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from codesign_bringup.bringup import _spawn, executable
from codesign_control.driver import prioritize_process

PERIOD = 0.01  # s between two commands, as of cartesian_controller
TOPICS = ("/joint_states", "/gripper_state", "/joint_command", "/gripper_command")
START_TIMEOUT = 30.0  # s until the driver streams
SETTLE = 10.0  # s of streaming before it counts: the nodes beside it have started by then
AMPLITUDE, SPEED = 0.1, 1.0  # rad, rad/s


class Commander(Node):
    """Stands in for the controller: holds what it first saw, then adds a wave."""

    def __init__(self) -> None:
        super().__init__("servo_bench")
        from codesign_nodes import qos

        self.first: np.ndarray | None = None
        self.diagnosis: dict[str, str] = {}
        self.waving = False
        self._publisher = self.create_publisher(
            JointCommand, "/bench/joint_command", qos.JOINT_COMMAND_OFFERED
        )
        self.create_subscription(JointState, "/bench/joint_states", self._on_state, qos.STATE)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos.EVERY)
        self.enable = self.create_client(SetBool, "/xarm_driver/enable")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the commands."""
        self._stop.set()
        self._thread.join()

    def _on_state(self, message: JointState) -> None:
        if self.first is None:
            self.first = np.array(message.position)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "/xarm_driver":
                self.diagnosis = {v.key: v.value for v in status.values}
                self.diagnosis["message"] = status.message

    def _run(self) -> None:
        due, phase = time.monotonic(), 0.0
        grid = self.get_clock().now().nanoseconds
        while not self._stop.is_set():
            due, grid = due + PERIOD, grid + round(PERIOD * 1e9)
            time.sleep(max(0.0, due - time.monotonic()))
            if self.first is None:
                continue
            phase += PERIOD if self.waving else 0.0
            position = self.first.copy()
            position[0] += AMPLITUDE * (1.0 - math.cos(SPEED * phase))
            message = JointCommand(position=position.tolist())
            message.valid_at = Time(nanoseconds=grid).to_msg()
            message.header.stamp = self.get_clock().now().to_msg()
            self._publisher.publish(message)


def driver_command(options: argparse.Namespace, deviations: Path) -> list[str]:
    """The driver on topics of its own, so that it and a simulator do not meet."""
    command = [str(executable("codesign_nodes", "xarm_driver")), "--ros-args"]
    parameters = {
        "address": options.address,
        "rate": options.rate,
        "realtime": str(options.realtime).lower(),
        "deviations_file": deviations,
    }
    for name, value in parameters.items():
        command += ["-p", f"{name}:={value}"]
    for topic in TOPICS:
        command += ["-r", f"{topic}:=/bench{topic}"]
    return command


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Streams for a while; what the driver says of it, and the lateness of each wake-up [s].

    Raises:
        TimeoutError: it does not stream.
    """
    rclpy.init()
    node = Commander()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinning = threading.Thread(target=executor.spin, daemon=True)
    spinning.start()
    with tempfile.TemporaryDirectory(prefix="servo-bench-") as folder:
        deviations = Path(folder, "deviations.npy")
        driver = _spawn(
            driver_command(options, deviations), options.nice, stdout=subprocess.DEVNULL
        )
        try:
            _start_streaming(node)
            before = dict(node.diagnosis)
            time.sleep(options.seconds + 1.1)  # and the next diagnostics
            after = dict(node.diagnosis)
        finally:
            driver.send_signal(signal.SIGINT)
            driver.wait(10.0)
            node.close()
            executor.shutdown()
            rclpy.try_shutdown()
        lateness = np.load(deviations)[-round(options.seconds * options.rate) :]
    return {
        "rate_hz": options.rate,
        "sched_fifo": after["sched_fifo"] == "True",
        "state": after["state"],
        "ticks_missed": int(after["ticks_missed"]) - int(before["ticks_missed"]),
        "replies_late": int(after["replies_late"]) - int(before["replies_late"]),
        "pauses": int(after["pauses"]),
        "lateness_s": np.round(lateness, 7).tolist(),
    }


def _start_streaming(node: Commander) -> None:
    _wait(lambda: node.first is not None, "joint states")
    _wait(node.enable.service_is_ready, "service enable")
    asked = node.enable.call_async(SetBool.Request(data=True))
    _wait(asked.done, "answer of enable")
    if not asked.result().success:
        raise TimeoutError(asked.result().message)
    _wait(lambda: node.diagnosis.get("state") == "streaming", "streaming")
    node.waving = True
    time.sleep(SETTLE)


def _wait(condition: Any, what: str) -> None:
    deadline = time.monotonic() + START_TIMEOUT
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"no {what} within {START_TIMEOUT:g} s")
        time.sleep(0.02)


def main() -> None:
    """Command line; see the module's docstring."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--address", required=True, help="of the fake control box: 127.x.y.z")
    parser.add_argument("--rate", type=int, default=100, help="servo points [Hz]")
    parser.add_argument("--realtime", action="store_true", help="SCHED_FIFO, where permitted")
    parser.add_argument("--nice", type=int, default=0, help="of the driver, where permitted")
    parser.add_argument("--seconds", type=float, default=30.0, help="that count")
    parser.add_argument("--out", type=Path, required=True, help="JSON")
    options = parser.parse_args()
    if not options.address.startswith("127."):
        parser.error(f"--address {options.address}: the arm would move; only 127.x.y.z")
    prioritize_process(20)  # the commands are to come in time: they are not what is measured
    try:
        result = measure(options)
    except TimeoutError as error:
        print(f"servo_bench: {error}", file=sys.stderr)
        sys.exit(1)
    options.out.write_text(json.dumps(result))


if __name__ == "__main__":
    main()
