"""Node finger_design: makes fingers on request and tells the graph which ones are mounted.

It is the one publisher of /finger_design. An order comes as parameters in a design space, as a
target mesh for inverse design (cage "none": as it is), or as an expert's name with neither. The
work is done in another process, one order at a time: the same order again waits for the same
answer (a reply may be lost on its way), another one is refused, not queued.
"""

from pathlib import Path
from typing import Any

import numpy as np
from codesign_interfaces.msg import FingerDesign
from codesign_interfaces.srv import GenerateDesign
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future

from codesign_design.finger_pair import MAX_TRIANGLES, FingerPair, TriangleMesh
from codesign_design.stock import stock_fingers
from codesign_nodes import messages, qos
from codesign_nodes.background import Job, JobError
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, run, steady_clock

POLL_PERIOD = 0.05  # s
Order = tuple[str, str, tuple[float, ...], tuple[bytes, bytes] | None, int]
LIBRARY = "codesign_design.order"  # takes seconds to import; only the other process does


class FingerDesigner(LeanNode):
    """Serves `~/generate_design`."""

    def __init__(self) -> None:
        super().__init__("finger_design")
        self._folder = Path(
            declare(self, "output_dir", "runs/designs", "folder of the files, one folder per hash")
        )
        initial = declare(
            self,
            "initial",
            "stock",
            "fingers mounted at the start: an expert's name, or the folder of a finger's files",
        )
        self._limit = declare(
            self, "time_limit", 120.0, "longest time for one order [s]", low=1.0, high=3600.0
        )
        self._job: Job | None = None
        self._in_hand: Order | None = None
        self._outcome = Future()
        self._label = "none"
        self._delivered = self._refused = 0
        self._last_refusal = ""
        self._pub = self.create_publisher(FingerDesign, "/finger_design", qos.LATCHED)
        self._publish(_initial(initial))
        # In a group of its own: a second order is to be refused while the first is in hand.
        self.create_service(
            GenerateDesign,
            "~/generate_design",
            self._on_generate,
            callback_group=ReentrantCallbackGroup(),
        )
        self._timer = self.create_timer(POLL_PERIOD, self._watch, clock=steady_clock())
        self._diagnostics = Diagnostics(self, self._report)

    def close(self) -> None:
        """Ends what is in hand."""
        if self._job is not None:
            self._job.stop()

    async def _on_generate(
        self, request: GenerateDesign.Request, response: GenerateDesign.Response
    ) -> GenerateDesign.Response:
        try:
            order = _order(request)
            if self._job is None:
                self._start(order)
            elif order != self._in_hand:
                raise JobError(
                    f"another order is in hand for {self._job.seconds:.1f} s: ask again later"
                )
            fingers, message, files, report = await self._outcome
        except JobError as error:
            self._refused += 1
            self._last_refusal = response.message = str(error)
            self.get_logger().warning(f"no fingers: {error}")
            return response
        response.design, response.files, response.report = message, files, report
        response.success, response.message = True, f"published {fingers}"
        return response

    def _start(self, order: Order) -> None:
        self._in_hand, self._outcome = order, Future()
        self._job = Job(_deliver, order, self._folder, limit=self._limit, preload=(LIBRARY,))

    def _watch(self) -> None:
        """Publishes what has become ready, and lets everybody know who waits for it."""
        if self._job is None or not self._job.done():
            return
        job, self._job = self._job, None
        try:
            fingers, report, files = job.result()
        except JobError as error:
            self._outcome.set_exception(error)
            return
        self._delivered += 1
        message = self._publish(fingers)
        self._outcome.set_result((self._label, message, files, report))

    def _publish(self, fingers: FingerPair) -> FingerDesign:
        message = messages.design_message(fingers)
        message.header.stamp = self.get_clock().now().to_msg()
        self._pub.publish(message)
        self._label = f"{fingers.name} {fingers.content_hash[:12]}"
        self.get_logger().info(f"fingers {self._label}")
        return message

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        values = {
            "fingers": self._label,
            "delivered": self._delivered,
            "refused": self._refused,
            "last_refusal": self._last_refusal,
        }
        words = "idle" if self._job is None else f"at work for {self._job.seconds:.0f} s"
        return DiagnosticStatus.OK, words, values


def _order(request: GenerateDesign.Request) -> Order:
    """The request as plain values that can be compared and pickled; raises JobError."""
    triangles = len(request.target.triangles)
    if triangles > MAX_TRIANGLES:
        raise JobError(f"target has {triangles} triangles: at most {MAX_TRIANGLES}; simplify it")
    target = messages.mesh_from(request.target)
    mesh = (target.vertices.tobytes(), target.faces.tobytes()) if triangles else None
    return request.name, request.cage, tuple(request.parameters), mesh, int(request.seed)


def _deliver(order: Order, folder: Path) -> tuple[FingerPair, str, list[str]]:
    """In the other process: pair, report and paths of the files."""
    from codesign_design.order import DesignOrder, deliver

    name, cage, parameters, mesh, seed = order
    target = None
    if mesh is not None:
        vertices, faces = np.frombuffer(mesh[0], float), np.frombuffer(mesh[1], np.int32)
        target = TriangleMesh(vertices.reshape(-1, 3), faces.reshape(-1, 3))
    delivery = deliver(DesignOrder(name, cage, parameters, target, seed), folder)
    return delivery.pair, delivery.report, [str(path) for path in delivery.files]


def _initial(name: str) -> FingerPair:
    if name == "stock":
        return stock_fingers()
    if Path(name).is_dir():
        from codesign_design.finger_files import load_finger_pair

        return load_finger_pair(Path(name))
    from codesign_design.experts import expert

    return expert(name)


def main() -> None:
    """Runs the node."""
    run(FingerDesigner)
