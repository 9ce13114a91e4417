"""Node trial_recorder: every topic of the graph, as it came over the wire, into a rosbag2 MCAP.

Messages are not decoded. A thread of its own writes them, so that a slow or full disk never
reaches the control loop. Types, type hashes and the offered QoS are stored with each topic. Twice
a second what was received goes to the file as a piece that can be read by itself: that is all that
is lost when the recorder is killed.
"""

import importlib
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ament_index_python.packages import get_package_share_directory
from codesign_interfaces.srv import StartRecording, StopRecording
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, run, steady_clock

OBSERVED = (
    "/object_pose",
    "/tcp_pose",
    "/gripper_state",
    "/joint_states",
    "/stress",
    "/simulation_state",
    "/camera/image/compressed",
)
DEPTH = 1000  # messages that a subscription may keep while the executor is busy
QUEUE = 20_000  # messages that may wait for the disk
MATCH_TIMEOUT = 4.0  # s
SETTLED = 0.7  # s; a reader may know a writer that long before the writer knows it
DRAIN_TIMEOUT = 3.0  # s
FLUSH_PERIOD = 0.5  # s
QUIET = 0.1  # s without a message from before the stop


class TrialRecorder(LeanNode):
    """Records between the services ~/start and ~/stop."""

    def __init__(self) -> None:
        super().__init__("trial_recorder")
        self._excluded = set(
            declare(self, "exclude", ["/parameter_events"], "topics that are not recorded")
        )
        self._observed = set(
            declare(
                self,
                "observed",
                [*OBSERVED],
                "topics whose newest message from before ~/start is recorded, too: a policy's "
                "first action answers it",
            )
        )
        self._matches, self._matched_at = 0, time.monotonic()
        self._types = _type_store()
        self._subscriptions_by_topic: dict[str, Any] = {}
        self._newest: dict[str, bytes] = {}  # of latched and observed topics
        self._unknown: set[str] = set()
        self._bag: BagWriter | None = None
        self._stop_asked = 0  # ns, system time
        self._late_at = 0.0  # s, when a message from before that came last
        waiting = ReentrantCallbackGroup()
        self.create_service(StartRecording, "~/start", self._on_start, callback_group=waiting)
        self.create_service(StopRecording, "~/stop", self._on_stop, callback_group=waiting)
        # Topics are subscribed to all the time: a trial's first message must not be lost to
        # discovery.
        self._timer = self.create_timer(0.25, self._discover, clock=steady_clock())
        self._diagnostics = Diagnostics(self, self._report)

    def _discover(self) -> None:
        for topic, types in self.get_topic_names_and_types():
            known = topic in self._subscriptions_by_topic or topic in self._unknown
            hidden = any(part.startswith("_") for part in topic.split("/"))
            if known or hidden or topic in self._excluded or not types:
                continue
            offered = self.get_publishers_info_by_topic(topic)
            if offered:
                self._subscribe(topic, types[0], offered[0].qos_profile)
        found = (s.get_publisher_count() for s, *_ in self._subscriptions_by_topic.values())
        if (matches := sum(found)) != self._matches:
            self._matches, self._matched_at = matches, time.monotonic()

    def _subscribe(self, topic: str, type_name: str, offered: QoSProfile) -> None:
        try:
            message_type = _message_class(type_name)
        except (ImportError, AttributeError) as error:
            self._unknown.add(topic)
            self.get_logger().warning(f"{topic} is not recorded: {error}")
            return
        latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
        kept = latched or topic in self._observed
        requested = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=offered.reliability,
            durability=offered.durability,
        )

        def receive(data: bytes, info: dict[str, int]) -> None:
            if kept:
                self._newest[topic] = data
            if info["source_timestamp"] < self._stop_asked:
                self._late_at = time.monotonic()
            if self._bag is not None:
                self._bag.put(topic, self.get_clock().now().nanoseconds, data)

        def receive_all(data: bytes, info: dict[str, int]) -> None:
            """The executor hands over one message per round; what waits behind it is taken at
            once, or the busiest topics would fall behind on a busy machine."""
            receive(data, info)
            for _ in range(DEPTH):
                waiting = subscription.handle.take_message(message_type, True)
                if waiting is None:
                    return
                receive(*waiting)

        subscription = self.create_subscription(
            message_type, topic, receive_all, requested, raw=True
        )
        self._subscriptions_by_topic[topic] = subscription, type_name, offered

    async def _on_start(
        self, request: StartRecording.Request, response: StartRecording.Response
    ) -> StartRecording.Response:
        await self._until_matched()
        path = Path(request.uri)
        if self._bag is not None:
            # Asked again for the same bag, because the first answer was lost: all is well.
            response.success = self._bag.path == path
            advice = "" if response.success else ": call ~/stop first"
            response.message = f"already recording {self._bag.path}{advice}"
            return response
        if path.exists() or not path.name:
            response.message = f"bag {request.uri!r}: exists already, choose a new folder"
            return response
        try:
            self._bag = BagWriter(path, self._types, self._topic_info)
        except OSError as error:
            response.message = f"bag {path}: {error}"
            return response
        now = self.get_clock().now().nanoseconds
        for topic, data in self._newest.items():
            self._bag.put(topic, now, data)
        response.success, response.message = True, str(path)
        return response

    async def _until_matched(self) -> None:
        """Returns once every publisher of every topic reaches us, and has done so for a while: from
        now on nothing is missed."""
        patience = MATCH_TIMEOUT
        while patience > 0.0:
            self._discover()
            missing = [
                topic
                for topic, (subscription, *_) in self._subscriptions_by_topic.items()
                if subscription.get_publisher_count() < self.count_publishers(topic)
            ]
            if not missing and time.monotonic() - self._matched_at > SETTLED:
                return
            await self.sleep(0.05)
            patience -= 0.05
        if missing:
            self.get_logger().warning(f"recording without all publishers of {', '.join(missing)}")

    async def _until_drained(self) -> bool:
        """Returns once what was published before now has come in, or too much time has passed."""
        self._stop_asked, self._late_at = time.time_ns(), time.monotonic()
        deadline = self._late_at + DRAIN_TIMEOUT
        while self._late_at + QUIET > time.monotonic() < deadline:
            await self.sleep(QUIET / 2)
        self._stop_asked = 0
        return time.monotonic() < deadline

    def _topic_info(self, topic: str) -> tuple[str, QoSProfile]:
        _, type_name, offered = self._subscriptions_by_topic[topic]
        return type_name, offered

    async def _on_stop(
        self, _: StopRecording.Request, response: StopRecording.Response
    ) -> StopRecording.Response:
        all_came = await self._until_drained()
        if self._bag is None:
            response.message = "not recording"
            return response
        bag, self._bag = self._bag, None
        bag.close()
        problem = bag.error
        if not problem and (bag.lost or not all_came):
            problem = f"{bag.path} lacks messages: the machine is too busy, or its disk too slow"
        response.success, response.message = not problem, problem or str(bag.path)
        response.messages = bag.written
        return response

    def close(self) -> None:
        """Finishes an open bag."""
        if self._bag is not None:
            self._bag.close()

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        values: dict[str, Any] = {"topics": len(self._subscriptions_by_topic)}
        if self._bag is None:
            return DiagnosticStatus.OK, "idle", values
        values |= {"bag": self._bag.path, "written": self._bag.written, "lost": self._bag.lost}
        if self._bag.error or self._bag.lost:
            return DiagnosticStatus.ERROR, self._bag.error or "the disk is too slow", values
        return DiagnosticStatus.OK, "recording", values


class BagWriter:
    """Writes serialised messages to a bag on its own thread."""

    def __init__(
        self, path: Path, types: Any, topic_info: Callable[[str], tuple[str, QoSProfile]]
    ) -> None:
        """Creates the folder.

        Args:
            path: of the bag; must not exist.
            types: rosbags type store that knows every type.
            topic_info: type name and offered QoS of a topic.

        Raises:
            OSError: the folder cannot be made.
        """
        self.path = path
        self.error = ""
        self.written = 0
        self.lost = 0
        self._types = types
        self._topic_info = topic_info
        self._connections: dict[str, Any] = {}
        self._queue: queue.Queue[tuple[str, int, bytes] | None] = queue.Queue(QUEUE)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._thread = threading.Thread(target=self._write_all, name="bag", daemon=True)
        self._thread.start()

    def put(self, topic: str, time_ns: int, data: bytes) -> None:
        """Hands a message over; never waits."""
        try:
            self._queue.put_nowait((topic, time_ns, data))
        except queue.Full:
            self.lost += 1

    def close(self) -> None:
        """Writes what is left and finishes the file."""
        self._queue.put(None)
        self._thread.join()

    def _write_all(self) -> None:
        flushed = time.monotonic()
        while (item := self._next(flushed + FLUSH_PERIOD)) is not None:
            if item and not self.error:
                self._guarded(lambda item=item: self._write(*item))
            if time.monotonic() >= flushed + FLUSH_PERIOD:
                flushed = time.monotonic()
                if not self.error:
                    self._guarded(self._flush)
        # After an error the file ends where it failed: an index would point behind it.
        self._guarded(self._writer.abort if self.error else self._writer.close)

    def _next(self, until: float) -> tuple[str, int, bytes] | tuple[()] | None:
        """What comes before a time [s]: a message, None at the end, or () for nothing."""
        try:
            return self._queue.get(timeout=max(until - time.monotonic(), 0.0))
        except queue.Empty:
            return ()

    def _flush(self) -> None:
        """Hands the file what was received so far, as a chunk that can be read by itself."""
        storage = self._writer.storage
        if storage.chunk.msgs:
            storage.close_chunk()
        storage.bio.flush()

    def _guarded(self, do: Callable[[], None]) -> None:
        try:
            do()
        except Exception as error:  # a full disk must not end the node
            self.error = self.error or f"{type(error).__name__}: {error}"

    def _write(self, topic: str, time_ns: int, data: bytes) -> None:
        if topic not in self._connections:
            type_name, offered = self._topic_info(topic)
            self._connections[topic] = self._writer.add_connection(
                topic,
                type_name,
                typestore=self._types,
                serialization_format="cdr",
                offered_qos_profiles=[_bag_qos(offered)],
            )
        self._writer.write(self._connections[topic], time_ns, data)
        self.written += 1


def _message_class(type_name: str) -> Any:
    """The class of "package/msg/Name"."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def _type_store() -> Any:
    """Jazzy's types and ours."""
    store = get_typestore(Stores.ROS2_JAZZY)
    ours: dict[str, Any] = {}
    for path in Path(get_package_share_directory("codesign_interfaces"), "msg").glob("*.msg"):
        ours |= get_types_from_msg(path.read_text(), f"codesign_interfaces/msg/{path.stem}")
    store.register(ours)
    return store


def _bag_qos(profile: QoSProfile) -> Qos:
    def duration(value: Any) -> QosTime:
        return QosTime(*divmod(value.nanoseconds, 1_000_000_000))

    history = (
        QosHistory.KEEP_ALL if profile.history == HistoryPolicy.KEEP_ALL else QosHistory.KEEP_LAST
    )
    reliable = profile.reliability == ReliabilityPolicy.RELIABLE
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    manual = profile.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC
    return Qos(
        history=history,
        depth=max(profile.depth, 1),
        reliability=QosReliability.RELIABLE if reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=duration(profile.deadline),
        lifespan=duration(profile.lifespan),
        liveliness=QosLiveliness.MANUAL_BY_TOPIC if manual else QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=duration(profile.liveliness_lease_duration),
        avoid_ros_namespace_conventions=False,
    )


def main() -> None:
    """Runs the node."""
    run(TrialRecorder)
