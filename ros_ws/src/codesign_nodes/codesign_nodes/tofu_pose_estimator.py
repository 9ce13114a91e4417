"""Node tofu_pose_estimator: /object_pose from the camera's pictures.

Each picture is answered in its own callback, stamped with the picture's stamp; where the block is
not found with certainty no pose is published but the picture's stamp on /object_pose/rejected, and
/diagnostics says why. A picture that comes a
second time is answered a second time, as in lockstep something may have been lost.
"""

import time
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from codesign_interfaces.msg import GripperState
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from codesign_nodes import messages, qos
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, nanoseconds, run
from codesign_perception.board import CharucoBoard
from codesign_perception.calibration import CalibrationError, calibrate_extrinsics, flat_pose
from codesign_perception.camera import FRAME, Camera
from codesign_perception.camera_file import CameraFile, Record, load_camera
from codesign_perception.config import EstimatorConfig
from codesign_perception.debug_picture import debug_picture
from codesign_perception.edges import Image
from codesign_perception.frames import FrameGate, encode
from codesign_perception.hand import Hand
from codesign_perception.tofu_pose import Detection, TofuPose, TofuPoseEstimator

UPRIGHT_VARIANCE = 0.01**2  # rad^2: the block is taken to stand upright
SILENCE = 1.0  # s without a picture that are reported


class TofuPoseEstimatorNode(LeanNode):
    """Wraps `TofuPoseEstimator`."""

    def __init__(self) -> None:
        super().__init__("tofu_pose_estimator")
        self._lockstep = self.get_parameter("use_sim_time").value
        self._path = declare(self, "camera_file", "", "YAML file of the calibrated camera")
        if not self._path:
            raise ValueError(
                "parameter camera_file is empty: give the file that codesign perception calibrate "
                "has written"
            )
        self._config = self._declare_config()
        self._declare_board()
        max_age = declare(
            self, "max_image_age", 0.2, "of a picture at its arrival, real time only [s]",
            low=0.02, high=5.0,
        )  # fmt: skip
        frozen_after = declare(
            self, "frozen_after", 3, "equal pictures that mean a hanging camera; 0: never",
            low=0, high=100,
        )  # fmt: skip
        self._uses_hand = declare(
            self, "use_hand", True, "take the height of a held block from /tcp_pose"
        )
        self._debug_quality = declare(
            self, "debug_quality", 80, "of the JPEG debug pictures", low=10, high=100
        )
        self._gate = FrameGate(max_age, frozen_after)
        self._hand = Hand(self._config)
        self._info_error = ""
        self._use_camera(load_camera(self._path))
        self._image: Image | None = None
        self._answer: tuple[int, Detection] | None = None
        self._message = "waiting for pictures"
        self._heard_at: float | None = None
        self._counts: Counter[str] = Counter()
        self._busy, self._worst = 0.0, 0.0
        cv2.setNumThreads(1)
        self._make_interfaces()
        self._diagnostics = Diagnostics(self, self._report)

    def _declare_config(self) -> EstimatorConfig:
        c = EstimatorConfig()
        names = ("length", "width", "height")
        size = tuple(
            declare(self, f"size.{n}", s, f"{n} of the block as it is cut [m]", low=0.005, high=0.5)
            for n, s in zip(names, c.size, strict=True)
        )
        region = tuple(
            declare(self, f"region.{n}", v, "where the block may be [m]", low=-2.0, high=2.0)
            for n, v in zip(("x_min", "x_max", "y_min", "y_max"), c.region, strict=True)
        )
        ranges = {
            "sag": ("how far the block's top sinks under its weight [m]", 0.0, 0.05),
            "table_height": ("z of the table in link_base [m]", -0.5, 0.5),
            "max_lift": ("largest height above the table [m]", 0.01, 1.0),
            "min_contrast": ("brightness of block above table [grey levels]", 5.0, 200.0),
            "min_score": ("share of the outline that must agree", 0.2, 1.0),
            "min_held_score": ("the same while a hand holds the block", 0.2, 1.0),
            "max_denied": ("share of the outline that may contradict", 0.0, 0.5),
            "max_residual": ("distance at which an edge point disagrees [px]", 0.3, 10.0),
            "max_rms": ("of the edge points that agree [px]", 0.1, 5.0),
            "max_sigma": ("largest standard deviation that is told [m]", 0.0002, 0.1),
            "size_sigma": ("how exactly the block was cut [m]", 1e-6, 0.01),
            "size_tolerance": ("deviation from size at which it is something else [m]", 1e-4, 0.02),
        }
        assert set(ranges) <= {f.name for f in fields(EstimatorConfig)}
        values = {
            name: declare(self, name, getattr(c, name), text, low=low, high=high)
            for name, (text, low, high) in ranges.items()
        }
        lifted = declare(
            self, "allow_lifted", c.allow_lifted, "tell poses of a block that hovers without a hand"
        )
        return EstimatorConfig(size=size, region=region, allow_lifted=lifted, **values)

    def _declare_board(self) -> None:
        b = CharucoBoard()
        self._board = CharucoBoard(
            declare(self, "board.columns", b.columns, "squares of the board", low=3, high=20),
            declare(self, "board.rows", b.rows, "squares of the board", low=3, high=20),
            declare(self, "board.square", b.square, "edge of a square [m]", low=0.002, high=1.0),
            declare(self, "board.marker", b.marker, "edge of a marker [m]", low=0.001, high=1.0),
        )
        x, y, z, yaw = (
            declare(self, f"board.{n}", v, f"{n} of the board's middle in link_base", low=-7.0,
                    high=7.0)
            for n, v in (("x", 0.45), ("y", 0.0), ("z", 0.0), ("yaw", 0.0))
        )  # fmt: skip
        self._board_pose = flat_pose((x, y, z), yaw)
        self._calibrated_path = declare(
            self, "calibrated_file", "", "where ~/calibrate writes; empty: over camera_file"
        )

    def _make_interfaces(self) -> None:
        self._pose_pub = self.create_publisher(PoseStamped, "/object_pose", qos.POSE_OFFERED)
        self._rejected_pub = self.create_publisher(
            Header, "/object_pose/rejected", qos.STATE_OFFERED
        )
        self._covariance_pub = self.create_publisher(
            PoseWithCovarianceStamped, "~/pose_with_covariance", qos.STATE_OFFERED
        )
        self._debug_pub = self.create_publisher(
            CompressedImage, "~/debug/compressed", qos.IMAGE_OFFERED
        )
        self.create_subscription(
            CompressedImage, "/camera/image/compressed", self._on_image, qos.IMAGE_REQUESTED
        )
        self.create_subscription(CameraInfo, "/camera/camera_info", self._on_info, qos.LATCHED)
        if self._uses_hand:
            self.create_subscription(PoseStamped, "/tcp_pose", self._on_tcp, qos.POSE_REQUESTED)
            self.create_subscription(GripperState, "/gripper_state", self._on_gripper, qos.STATE)
        self.create_service(Trigger, "~/calibrate", self._on_calibrate)

    def _use_camera(self, camera: Camera) -> None:
        self._camera = camera
        self._estimator = TofuPoseEstimator(camera, self._config)

    # --- input

    def _on_info(self, message: CameraInfo) -> None:
        """The camera that sends must be the one that was calibrated."""
        self._info_error = ""
        if not any(message.k):  # a driver without a calibration of its own
            return
        try:
            told = Camera.from_info(
                message.width, message.height, message.k, message.d, message.distortion_model
            )
            if not told.same_lens(self._camera, 1e-3):
                raise ValueError("size or intrinsics differ from those of camera_file")
        except ValueError as error:
            self._info_error = f"/camera/camera_info: {error}"
            self.get_logger().error(self._info_error)

    def _on_tcp(self, message: PoseStamped) -> None:
        position = messages.from_xyz(message.pose.position)
        quaternion = messages.from_quaternion(message.pose.orientation)
        self._hand.add_pose(nanoseconds(message.header.stamp), position, quaternion)

    def _on_gripper(self, message: GripperState) -> None:
        self._hand.add_width(nanoseconds(message.header.stamp), message.width)

    def _on_image(self, message: CompressedImage) -> None:
        started = time.monotonic()
        self._heard_at = started
        self._counts["pictures"] += 1
        stamp = nanoseconds(message.header.stamp)
        if self._answer is not None and self._answer[0] == stamp:
            self._publish(self._answer[1], message.header.stamp)
            return
        detection = self._looked_at(message, stamp)
        self._answer = (stamp, detection)
        self._message = detection.reason
        if detection.pose is not None:
            self._hand.add_block(detection.pose)
        self._publish(detection, message.header.stamp)
        elapsed = time.monotonic() - started
        self._busy += elapsed
        self._worst = max(self._worst, elapsed)
        self._publish_debug(detection, message.header.stamp)

    def _looked_at(self, message: CompressedImage, stamp: int) -> Detection:
        """The block in a picture, or why there is none."""
        self._image = None
        now = stamp if self._lockstep else self.get_clock().now().nanoseconds
        data = memoryview(message.data)
        reason = self._gate.objection(stamp, now, data) or self._info_error
        if reason:
            return Detection(None, reason)
        image = self._gate.decoded(data)
        if image is None:
            return Detection(None, "picture cannot be decoded: it was damaged or cut off")
        try:
            detection = self._estimator.estimate(image, self._hand.held(stamp))
        except ValueError as error:  # another size than the calibrated camera's
            return Detection(None, str(error))
        self._image = image
        return detection

    # --- output

    def _publish(self, detection: Detection, stamp: Any) -> None:
        pose = detection.pose
        if pose is None:
            self._counts["without_block"] += 1
            # In lockstep the policy need not wait any longer for a pose of that moment.
            self._rejected_pub.publish(Header(stamp=stamp, frame_id=FRAME))
            return
        self._counts["poses"] += 1
        message = PoseStamped(pose=messages.pose(pose.position, pose.quaternion))
        message.header.stamp = stamp
        message.header.frame_id = "link_base"
        self._pose_pub.publish(message)
        self._publish_covariance(pose, message)

    def _publish_covariance(self, pose: TofuPose, plain: PoseStamped) -> None:
        covariance = np.diag([0.0, 0.0, 0.0, UPRIGHT_VARIANCE, UPRIGHT_VARIANCE, 0.0])
        known = [0, 1, 2, 5]  # x, y, z and the turn about z
        covariance[np.ix_(known, known)] = pose.covariance
        message = PoseWithCovarianceStamped(header=plain.header)
        message.pose.pose = plain.pose
        message.pose.covariance = covariance.ravel()
        self._covariance_pub.publish(message)

    def _publish_debug(self, detection: Detection, stamp: Any) -> None:
        if self._image is None or self._debug_pub.get_subscription_count() == 0:
            return
        message = CompressedImage(format="bgr8; jpeg compressed bgr8")
        picture = debug_picture(self._image, detection)
        message.data.frombytes(encode(picture, self._debug_quality))
        message.header.stamp = stamp
        message.header.frame_id = FRAME
        self._debug_pub.publish(message)

    # --- calibration

    def _on_calibrate(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """The camera's place from the board in the last picture, at the pose of the parameters."""
        try:
            response.message = self._calibrate()
            response.success = True
        except (CalibrationError, OSError) as error:
            response.message = str(error)
        return response

    def _calibrate(self) -> str:
        if self._image is None:
            raise CalibrationError(f"no usable picture: {self._message}")
        view = self._board.find(self._image)
        views = [] if view is None else [view]
        lens = CameraFile.load(self._path)
        found = calibrate_extrinsics(views, [self._board_pose] * len(views), lens.camera)
        path = Path(self._calibrated_path or self._path)
        record = Record.now("charuco", found.error, found.views)
        CameraFile(found.camera, lens.intrinsics, record).save(path)
        moved = 1e3 * float(np.linalg.norm(found.camera.position - self._camera.position))
        self._use_camera(found.camera)
        self._hand.reset()
        return f"{path}: reprojection error {found.error:.2f} px; camera moved by {moved:.1f} mm"

    # --- diagnostics

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        counts, gate = self._counts, self._gate.counts
        values = {
            "pictures": counts["pictures"],
            "poses": counts["poses"],
            "without_block": counts["without_block"],
            **{kind: gate[kind] for kind in ("empty", "corrupt", "stale", "frozen")},
            "ms_per_picture": round(1e3 * self._busy / max(counts["pictures"], 1), 1),
            "worst_ms": round(1e3 * self._worst, 1),
            "held": self._hand.holds,
        }
        self._worst = 0.0
        if self._answer is not None and self._answer[1].pose is not None:
            values["score"] = round(self._answer[1].score, 2)
            values["state"] = self._answer[1].pose.state
        if self._info_error:
            return DiagnosticStatus.ERROR, self._info_error, values
        if self._gate.frozen:
            return DiagnosticStatus.ERROR, self._message, values
        silent = self._heard_at is None or time.monotonic() - self._heard_at > SILENCE
        if silent:
            return DiagnosticStatus.WARN, "waiting for pictures", values
        if self._message:
            return DiagnosticStatus.WARN, self._message, values
        return DiagnosticStatus.OK, "running", values


def main() -> None:
    """Runs the node."""
    run(TofuPoseEstimatorNode)
