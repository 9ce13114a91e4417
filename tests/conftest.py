"""Shared by the tests that start processes: a DDS domain of their own, and a node that looks on."""

import contextlib
import gc
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

# Before anything talks DDS: apart from a person's own graph, and on this host only.
os.environ["ROS_DOMAIN_ID"] = str(50 + os.getpid() % 50)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    Path(__file__).parents[1] / "ros_ws" / "src" / "codesign_bringup" / "config" / "fastdds.xml"
)


LOG_FOLDER = pytest.StashKey[Path]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Any:
    """Shows what the nodes logged when a test with a graph fails."""
    report = yield
    if report.failed and LOG_FOLDER in item.stash:
        for log in sorted(item.stash[LOG_FOLDER].glob("*.log")):
            report.sections.append((f"log of {log.stem}", log.read_text()[-3000:]))
    return report


class Probe:
    """A node in the test's process: collects messages, calls services, publishes."""

    def __init__(self) -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node(f"probe_{os.getpid()}", context=self.context)
        self.received: dict[str, list[tuple[float, Any]]] = defaultdict(list)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        from rclpy.executors import ExternalShutdownException

        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join(5.0)
        # Or its latched messages would reach the next test.
        self.node.destroy_node()
        self.context.try_shutdown()

    def listen(self, topic: str, kind: Any, qos: Any) -> None:
        """Collects a topic in `received` as (monotonic time, message)."""
        self.node.create_subscription(
            kind, topic, lambda m: self.received[topic].append((time.monotonic(), m)), qos
        )

    def latest(self, topic: str) -> Any:
        return self.received[topic][-1][1]

    def wait_for(self, condition: Callable[[], Any], timeout: float, what: str) -> Any:
        """The first true value of `condition`; fails the test after `timeout` [s]."""
        return self.poll(condition, timeout) or pytest.fail(f"not within {timeout} s: {what}")

    def poll(self, condition: Callable[[], Any], timeout: float) -> Any:
        """The first true value of `condition`; None after `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            if value := condition():
                return value
            time.sleep(0.01)
        return None

    def run(self, function: Callable[[], Any]) -> Any:
        """What `function` returns when the executor's thread calls it.

        rclpy's action client may miss an answer that arrives while another thread still sends.
        """
        task = self._executor.create_task(function)
        self.wait_for(task.done, 20.0, "the executor's turn")
        return task.result()

    def call(self, name: str, kind: Any, request: Any, timeout: float = 20.0) -> Any:
        """The answer of a service, asked every 5 s.

        A reply is lost when the server has not discovered the client's reader yet.
        """
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(timeout), f"service {name} is not there"
        asked: list[Any] = []

        def answer() -> Any:
            if time.monotonic() - start >= 5.0 * len(asked):
                asked.append(self.run(lambda: client.call_async(request)))
            return next((future for future in asked if future.done()), None)

        start = time.monotonic()
        future = self.wait_for(answer, timeout, f"answer of {name}")
        self.node.destroy_client(client)
        return future.result()


@pytest.fixture
def probe() -> Iterator[Probe]:
    """A node in the test's own process."""
    # After a thousand tests a full collection stops this process, and with it whatever stands in
    # for an arm here, for longer than the controller's watchdogs wait.
    gc.collect()
    gc.freeze()
    probe = Probe()
    yield probe
    probe.close()
    gc.unfreeze()


@pytest.fixture
def graph(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    """Processes of the graph; all of them are ended after the test."""
    from codesign_bringup.bringup import Graph

    request.node.stash[LOG_FOLDER] = tmp_path / "logs"
    with Graph(tmp_path / "logs", quiet=True) as graph:
        yield graph
