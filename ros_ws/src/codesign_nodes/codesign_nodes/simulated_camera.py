"""Node simulated_camera: what a camera beside the simulated cell sees, as a driver would send it.

A process of its own, in the place of the real camera's node: rendering takes longer than a tick of
the simulator. With use_sim_time every state of the simulator gives one picture with its stamp,
equal for equal trials. At real time it takes the newest state, at most `rate` times a second.
"""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from codesign_interfaces.msg import FingerDesign, SimulationState, SoftBodyMesh
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import CameraInfo, CompressedImage, JointState

from codesign_nodes import messages, qos
from codesign_nodes.arm_shape import ArmShape
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, nanoseconds, run
from codesign_perception.camera import FRAME
from codesign_perception.camera_file import CameraFile
from codesign_policy.domain import POSITION
from codesign_report.recording import SoftBody, TriangleMesh
from codesign_report.rendered_camera import CAMERA_LOOK, Effects, RenderedCamera, SceneState

FRAME_NS = 50_000_000  # the simulator publishes its state 20 times a second
REPEAT_AFTER = 1.0  # s until the picture of a repeated state is sent again


class SimulatedCamera(LeanNode):
    """Renders /simulation_state and /joint_states to /camera/image/compressed."""

    def __init__(self) -> None:
        super().__init__("simulated_camera")
        self._lockstep = self.get_parameter("use_sim_time").value
        path = declare(self, "camera_file", "", "YAML file of the camera: lens and place")
        if not path:
            raise ValueError("parameter camera_file is empty: give the YAML file of the camera")
        self._camera = CameraFile.load(Path(path)).camera
        self._effects = self._declare_effects()
        self._table_height = declare(
            self, "table_height", 0.0, "z of the table in link_base [m]", low=-0.5, high=0.5
        )
        self._samples = declare(
            self, "samples", 4, "per pixel: 0, 2, 4 or 8; fewer are faster", low=0, high=8
        )
        self._quality = declare(self, "quality", 92, "of the JPEG pictures", low=30, high=100)
        self._rate = declare(
            self, "rate", 10.0, "real time: most pictures per second", low=0.5, high=20.0
        )
        self._arm = ArmShape()
        self._renderer: RenderedCamera | None = None
        self._mesh: SoftBodyMesh | None = None
        self._design: FingerDesign | None = None
        self._state: SimulationState | None = None
        self._joints: JointState | None = None
        self._last: CompressedImage | None = None
        self._taken_at = self._sent_at = 0.0
        self._pictures, self._busy = 0, 0.0
        self._report_at = time.monotonic()
        cv2.setNumThreads(1)
        self._make_interfaces()
        self._diagnostics = Diagnostics(self, self._report)

    def _declare_effects(self) -> Effects:
        d = Effects()
        return Effects(
            noise=declare(
                self, "noise", 3.0, "standard deviation [grey values]", low=0.0, high=100.0
            ),
            defocus=declare(self, "defocus", 0.7, "blur [px]", low=0.0, high=20.0),
            motion=declare(self, "motion", d.motion, "motion blur [px]", low=0.0, high=100.0),
            light=declare(
                self, "light", 0.1, "brightness varies within 1 +- this", low=0.0, high=0.9
            ),
            clutter=declare(self, "clutter", d.clutter, "things on the table", low=0, high=40),
            rotation_error=declare(
                self,
                "rotation_error",
                d.rotation_error,
                "angle between the camera and what camera_file says [rad]",
                low=0.0,
                high=0.5,
            ),
            translation_error=declare(
                self,
                "translation_error",
                d.translation_error,
                "distance between the camera and where camera_file says it is [m]",
                low=0.0,
                high=0.5,
            ),
            seed=declare(self, "seed", d.seed, "of noise, light and clutter", low=0, high=2**53),
        )

    def _make_interfaces(self) -> None:
        self._image_pub = self.create_publisher(
            CompressedImage, "/camera/image/compressed", qos.IMAGE_OFFERED
        )
        self._info_pub = self.create_publisher(CameraInfo, "/camera/camera_info", qos.LATCHED)
        self.create_subscription(SoftBodyMesh, "/soft_body_mesh", self._on_mesh, qos.LATCHED)
        self.create_subscription(FingerDesign, "/finger_design", self._on_design, qos.LATCHED)
        self.create_subscription(JointState, "/joint_states", self._on_joints, qos.STATE)
        self.create_subscription(SimulationState, "/simulation_state", self._on_state, qos.STATE)
        self._publish_info()

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    # --- what goes by

    def _on_mesh(self, message: SoftBodyMesh) -> None:
        before, self._mesh = self._mesh, message
        if before is None or before.surface_triangles != message.surface_triangles:
            self._start_anew()

    def _on_design(self, message: FingerDesign) -> None:
        before, self._design = self._design, message
        if before is None or before.content_hash != message.content_hash:
            self._start_anew()

    def _start_anew(self) -> None:
        """Other shapes: another scene, and another picture of the same moment."""
        self.close()
        self._last = None
        if self._mesh is not None and self._design is not None:
            self._renderer = self._make_renderer()
            self._take_if_complete()

    def _on_joints(self, message: JointState) -> None:
        self._joints = message
        if self._lockstep:  # at real time each new state, while it is new
            self._take_if_complete()

    def _on_state(self, message: SimulationState) -> None:
        self._state = message
        self._take_if_complete()

    def _take_if_complete(self) -> None:
        """One picture of each state, once the arm of the same moment is known."""
        state, joints = self._state, self._joints
        if state is None or joints is None or self._renderer is None:
            return
        if self._lockstep and joints.header.stamp != state.header.stamp:
            return
        now = time.monotonic()
        if self._last is not None and self._last.header.stamp == state.header.stamp:
            if now - self._sent_at > REPEAT_AFTER:  # the simulator waits: something was lost
                self._send(self._last)
        elif self._lockstep or now - self._taken_at > 0.95 / self._rate:
            self._taken_at = now
            self._last = self._picture(state, joints)
            self._send(self._last)

    # --- pictures

    def _picture(self, state: SimulationState, joints: JointState) -> CompressedImage:
        started = time.monotonic()
        self._arm.place(np.array(joints.position[:7]))
        picture = self._renderer.capture(
            SceneState(
                np.array(state.positions).reshape(-1, 3),
                _pose(state.left_finger),
                _pose(state.right_finger),
            ),
            self._number(state),
        )
        done, jpeg = cv2.imencode(
            ".jpg",
            cv2.cvtColor(picture, cv2.COLOR_RGB2BGR),
            [cv2.IMWRITE_JPEG_QUALITY, self._quality],
        )
        if not done:
            raise RuntimeError("OpenCV cannot write JPEG")
        message = CompressedImage(format="bgr8; jpeg compressed bgr8")
        message.data.frombytes(jpeg.tobytes())
        message.header.stamp = state.header.stamp
        message.header.frame_id = FRAME
        self._pictures += 1
        self._busy += time.monotonic() - started
        return message

    def _number(self, state: SimulationState) -> int:
        """Of the picture since the last reset, so that equal trials get equal noise."""
        since = nanoseconds(state.header.stamp) - nanoseconds(self._mesh.header.stamp)
        return max(0, round(since / FRAME_NS))

    def _send(self, message: CompressedImage) -> None:
        self._sent_at = time.monotonic()
        self._image_pub.publish(message)

    def _make_renderer(self) -> RenderedCamera:
        mesh, design = self._mesh, messages.design_from(self._design)
        body = SoftBody(
            np.array(mesh.rest_positions, dtype=np.float64).reshape(-1, 3),
            np.array(mesh.tetrahedra, dtype=np.int64).reshape(-1, 4),
            np.array(mesh.surface_triangles, dtype=np.int64).reshape(-1, 3),
            np.array(mesh.surface_tetrahedra, dtype=np.int64),
        )
        fingers = [
            TriangleMesh(np.asarray(m.vertices, np.float64), np.asarray(m.faces, np.int64))
            for m in (design.left, design.right)
        ]
        renderer = RenderedCamera(
            self._camera,
            body,
            fingers,
            effects=self._effects,
            props=self._arm.props,
            table_height=self._table_height,
            focus=POSITION,
            look=replace(CAMERA_LOOK, samples=self._samples),
        )
        # The first picture compiles shaders: not when a trial waits for it.
        rest, away = body.rest_positions, np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])
        renderer.capture(SceneState(rest, away, away))
        return renderer

    def _publish_info(self) -> None:
        info = CameraInfo(**self._camera.to_info())
        info.header.stamp = self.get_clock().now().to_msg()
        info.header.frame_id = FRAME
        self._info_pub.publish(info)

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        now = time.monotonic()
        span = max(now - self._report_at, 1e-9)
        values = {
            "pictures_per_second": round(self._pictures / span, 2),
            "ms_per_picture": round(1e3 * self._busy / max(self._pictures, 1), 1),
        }
        self._pictures, self._busy, self._report_at = 0, 0.0, now
        if self._last is None:
            return DiagnosticStatus.WARN, "waiting for the simulator", values
        return DiagnosticStatus.OK, "running", values


def _pose(pose: Any) -> np.ndarray:
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])


def main() -> None:
    """Runs the node."""
    run(SimulatedCamera)
