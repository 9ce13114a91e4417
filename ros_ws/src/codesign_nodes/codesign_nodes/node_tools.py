"""What every node needs: checked parameters, diagnostics, a main function."""

import gc
import math
import signal
import sys
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSCompatibility, qos_check_compatible
from rclpy.task import Future
from rclpy.time import Time


class LeanNode(Node):
    """A node whose publishers and subscriptions come without QoS event handlers.

    rclpy gives each of them two or three, only to log a mismatch, and its executors go through
    all of them at every wake-up: more than half of a busy node's CPU time. `Diagnostics` reports
    mismatches instead.
    """

    def create_subscription(self, *args: Any, **kwargs: Any) -> Any:
        """As in Node."""
        kwargs.setdefault(
            "event_callbacks", SubscriptionEventCallbacks(use_default_callbacks=False)
        )
        return super().create_subscription(*args, **kwargs)

    def create_publisher(self, *args: Any, **kwargs: Any) -> Any:
        """As in Node."""
        kwargs.setdefault("event_callbacks", PublisherEventCallbacks(use_default_callbacks=False))
        return super().create_publisher(*args, **kwargs)

    async def sleep(self, duration: float) -> None:
        """Lets other callbacks run meanwhile [s, steady clock].

        Only for callbacks whose group is reentrant.
        """
        future = Future()

        def wake() -> None:
            if not future.done():
                future.set_result(None)

        timer = self.create_timer(duration, wake, clock=steady_clock())
        await future
        self.destroy_timer(timer)

    async def until_heard(self, patience: float = 3.0) -> None:
        """Returns once every known subscription gets what is published here, or after `patience`.

        A reader can know a writer before the writer knows it; until then it misses messages.
        """
        while patience > 0.0 and any(
            publisher.get_subscription_count() < self.count_subscribers(publisher.topic_name)
            for publisher in self.publishers
        ):
            await self.sleep(0.05)
            patience -= 0.05

    def mismatched_topics(self) -> list[str]:
        """Subscribed topics none of whose publishers offers the QoS that is asked for."""
        found = []
        for subscription in self.subscriptions:
            if subscription.get_publisher_count():  # somebody fits; asking further takes long
                continue
            for offered in self.get_publishers_info_by_topic(subscription.topic_name):
                verdict, _ = qos_check_compatible(offered.qos_profile, subscription.qos_profile)
                if verdict == QoSCompatibility.ERROR:
                    found.append(subscription.topic_name)
        return sorted(set(found))


def declare(
    node: Node,
    name: str,
    default: Any,
    description: str,
    *,
    low: float | None = None,
    high: float | None = None,
    read_only: bool = True,
) -> Any:
    """Declares a parameter, read-only unless told otherwise, and returns its value.

    A value of the wrong type or outside [low, high] makes the node fail to start, with a message
    that names it.
    """
    descriptor = ParameterDescriptor(description=description, read_only=read_only)
    if low is not None and high is not None:
        if isinstance(default, float):
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    value = node.declare_parameter(name, default, descriptor).value
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"parameter {name} {value}: must be finite")
    return value


def seconds(stamp: Any) -> float:
    """A message stamp in seconds; exact to a microsecond for the current epoch."""
    return stamp.sec + stamp.nanosec * 1e-9


def nanoseconds(stamp: Any) -> int:
    """A message stamp as a whole number of nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def stamp_of(nanoseconds_: int) -> Any:
    """The message stamp of a whole number of nanoseconds."""
    return Time(nanoseconds=nanoseconds_).to_msg()


class Diagnostics:
    """Publishes one status a second on /diagnostics.

    Args:
        node: its owner.
        report: gives (level, message, values) when asked.
    """

    def __init__(
        self, node: LeanNode, report: Callable[[], tuple[bytes, str, dict[str, Any]]]
    ) -> None:
        self._node = node
        self._report = report
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._timer = node.create_timer(1.0, self.publish, clock=steady_clock())

    def publish(self) -> None:
        """Publishes now."""
        level, message, values = self._report()
        mismatched = self._node.mismatched_topics()
        if mismatched:
            level, message = DiagnosticStatus.ERROR, f"QoS mismatch on {', '.join(mismatched)}"
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name(),
            message=message,
            hardware_id="codesign",
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


def steady_clock() -> Any:
    """The clock of watchdogs and timers: never jumps, runs without /clock."""
    from rclpy.clock import Clock, ClockType

    return Clock(clock_type=ClockType.STEADY_TIME)


def run(make_node: Callable[[], Node]) -> None:
    """Runs one node until SIGINT or SIGTERM; the main function of every executable.

    Exits with 0 when stopped by a signal, with 1 and one line on an error.
    """
    spinning = stopped = False

    def interrupt(*_: Any) -> None:
        """While it spins, rclpy's own handler ends that: an exception from here, amid the
        conversion of a message, would come out as an error of the conversion."""
        nonlocal stopped
        stopped = True
        if not spinning:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)  # before rclpy's, which calls it too
    rclpy.init()
    node: Node | None = None
    executor: SingleThreadedExecutor | None = None
    code = 0
    try:
        node = make_node()
        executor = SingleThreadedExecutor()
        # What is loaded by now stays: the collector need not walk through it in the middle of a
        # control period.
        gc.collect()
        gc.freeze()
        executor.add_node(node)
        spinning = True
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception as error:
        if not stopped and rclpy.ok():  # else: a callback that the end of the context cut short
            name = node.get_name() if node else make_node.__name__
            print(f"{name}: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            code = 1
    finally:
        if node is not None:
            close = getattr(node, "close", None)
            if close is not None:
                close()
            node.destroy_node()
        rclpy.try_shutdown()
        if executor is not None:
            executor.shutdown(timeout_sec=1.0)
        # What is still there when the interpreter ends, some bindings report as leaked.
        node = executor = None
        gc.unfreeze()
        gc.collect()
    sys.exit(code)
