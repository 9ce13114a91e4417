"""What a person at the arm does between trials, where no `ros2` command is installed.

    operate status              how every node is, from /diagnostics
    operate enable              the driver may move the arm; it moves when commands come
    operate home --speed 0.1    to the start posture, jerk-limited; --width 0.06 sets the gap, too
    operate disable             arm and controller stop within their limits and stay disabled
    operate recover             after an emergency stop or an error, once its cause is gone

Exit codes: 0 done, 1 refused or not well, 3 no answer, 130 interrupted.
"""

import argparse
import math
import sys
import time
from typing import Any

import rclpy
from codesign_interfaces.action import MoveTo
from codesign_interfaces.msg import ControllerStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

NO_ANSWER = 3
PATIENCE = 10.0  # s, for a node to appear, and for an arm to follow
ASK_AGAIN = 5.0  # s; a reply is lost while the nodes still find each other
LISTEN = 2.5  # s; every node reports once a second
# s; an arm's driver begins with commands that stand where the arm stands, and needs to see some.
MATCH_PAUSE = 0.5
FOLLOWED = 0.02  # rad, an arm this close to its set-points follows them
WORDS = {
    DiagnosticStatus.OK: "ok",
    DiagnosticStatus.WARN: "WARNING",
    DiagnosticStatus.ERROR: "ERROR",
    DiagnosticStatus.STALE: "STALE",
}


class Refused(RuntimeError):
    """A node said no; the message says which and why."""


class Silent(RuntimeError):
    """A node is not there or does not answer."""


class Operator(Node):
    """Calls one service after the other."""

    def __init__(self) -> None:
        super().__init__("operate")
        self._tracking_error = math.nan  # rad
        self.create_subscription(
            ControllerStatus, "/cartesian_controller/status", self._hear_controller, 1
        )

    def enable(self, node: str, on: bool = True) -> str:
        """Enables or disables a node; its words."""
        return self._call(f"/{node}/enable", SetBool, SetBool.Request(data=on))

    def trigger(self, service: str) -> str:
        """Calls a service without arguments; its words."""
        return self._call(service, Trigger, Trigger.Request())

    def go_home(self, width: float, speed: float) -> str:
        """Moves to the start posture through the controller, which is enabled for it.

        Args:
            width: gap [m]; NaN: as it is.
            speed: share of the joints' velocity limit.
        """
        client = ActionClient(self, MoveTo, "/cartesian_controller/move_to")
        if not client.wait_for_server(PATIENCE):
            raise Silent(f"no action /cartesian_controller/move_to within {PATIENCE:g} s")
        self.enable("cartesian_controller")
        time.sleep(MATCH_PAUSE)
        try:
            goal = MoveTo.Goal(width=width, speed_scale=speed)
            handle = self._wait(client.send_goal_async(goal), ASK_AGAIN, "the goal's acceptance")
            if not handle.accepted:
                raise Refused("cartesian_controller refused the goal")
            result = self._wait(handle.get_result_async(), 120.0, "the end of the motion").result
            if result.success:
                self._require_followed()
        finally:
            self.enable("cartesian_controller", on=False)
        if not result.success:
            raise Refused(f"cartesian_controller: {result.message}")
        return "arrived"

    def _require_followed(self) -> None:
        """Raises Refused when the arm is not where the set-points went, as a disabled one."""
        until = time.monotonic() + PATIENCE
        self._tracking_error = math.nan  # what was said before the arrival does not count
        while time.monotonic() < until:
            rclpy.spin_once(self, timeout_sec=0.1)
            if self._tracking_error < FOLLOWED:
                return
        raise Refused(
            f"the arm did not follow, it is {self._tracking_error:.3f} rad away: is the driver "
            "enabled? `operate status` says, `operate enable` does it"
        )

    def _hear_controller(self, message: ControllerStatus) -> None:
        self._tracking_error = message.tracking_error

    def health(self) -> dict[str, DiagnosticStatus]:
        """The newest status of every node that reports within some seconds."""
        found: dict[str, DiagnosticStatus] = {}

        def hear(array: DiagnosticArray) -> None:
            found.update({status.name: status for status in array.status})

        self.create_subscription(DiagnosticArray, "/diagnostics", hear, 50)
        until = time.monotonic() + LISTEN
        while time.monotonic() < until:
            rclpy.spin_once(self, timeout_sec=0.1)
        return found

    def _call(self, name: str, kind: Any, request: Any) -> str:
        client = self.create_client(kind, name)
        if not client.wait_for_service(PATIENCE):
            raise Silent(f"no service {name} within {PATIENCE:g} s: is the graph up?")
        for _ in range(3):
            asked = client.call_async(request)
            rclpy.spin_until_future_complete(self, asked, timeout_sec=ASK_AGAIN)
            if asked.done():
                answer = asked.result()
                if not answer.success:
                    raise Refused(f"{name}: {answer.message}")
                return f"{name}: {answer.message or 'done'}"
        raise Silent(f"{name} does not answer: see that node's log")

    def _wait(self, future: Any, timeout: float, what: str) -> Any:
        rclpy.spin_until_future_complete(self, future, timeout_sec=timeout)
        if not future.done():
            raise Silent(f"{what}: nothing within {timeout:g} s")
        return future.result()


def status(operator: Operator) -> int:
    """Prints one line per node; 1 if one is not well, 3 if none reports."""
    found = operator.health()
    if not found:
        raise Silent(f"nothing on /diagnostics within {LISTEN:g} s: is the graph up?")
    for name in sorted(found):
        said = found[name]
        dry = "  [DRY RUN]" * any((v.key, v.value) == ("dry_run", "True") for v in said.values)
        print(f"{name:<24} {WORDS.get(said.level, '?'):<8} {said.message}{dry}")
    return int(any(said.level >= DiagnosticStatus.ERROR for said in found.values()))


def recover(operator: Operator) -> None:
    """The driver clears its errors, the controller its fault; then motion may be asked for."""
    print(operator.trigger("/xarm_driver/recover"))
    print(operator.trigger("/cartesian_controller/reset_fault"))


def disable(operator: Operator) -> None:
    """The controller brakes within its limits first."""
    print(operator.enable("cartesian_controller", on=False))
    print(operator.enable("xarm_driver", on=False))


def _run(options: argparse.Namespace) -> int:
    operator = Operator()
    if options.command == "status":
        return status(operator)
    if options.command == "enable":
        print(operator.enable("xarm_driver"))
    elif options.command == "disable":
        disable(operator)
    elif options.command == "recover":
        recover(operator)
    elif options.command == "home":
        print(operator.go_home(options.width, options.speed))
    return 0


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="operate", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = ["status", "enable", "disable", "recover", "home"]
    parser.add_argument("command", choices=commands)
    parser.add_argument(
        "--speed", type=float, default=0.1, help="of home, share of the joints' velocity limit"
    )
    parser.add_argument(
        "--width", type=float, default=math.nan, help="of home, gap [m]; else it stays as it is"
    )
    options = parser.parse_args()
    rclpy.init()
    try:
        code = _run(options)
    except Refused as error:
        print(f"operate: {error}", file=sys.stderr)
        code = 1
    except Silent as error:
        print(f"operate: {error}", file=sys.stderr)
        code = NO_ANSWER
    except (KeyboardInterrupt, ExternalShutdownException):
        code = 130
    finally:
        rclpy.try_shutdown()
    sys.exit(code)
