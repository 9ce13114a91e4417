"""The nodes that look: pictures in, the block's pose out; and a video file as a camera."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from codesign_bringup.bringup import Graph

from codesign_perception.board import CharucoBoard
from codesign_perception.calibration import flat_pose
from codesign_perception.camera import Camera
from codesign_perception.camera_file import load_camera, save_camera
from codesign_perception.frames import decode, encode
from tests.codesign_perception import synthetic
from tests.conftest import Probe

CAMERA = Camera.looking_at([0.78, 0.06, 0.30], [0.45, 0.0, 0.03], focal=1000.0)
TRUTH = np.array([0.46, 0.01, 0.02, 0.3])
BOARD_AT = (0.45, 0.02, 0.0)


class Eyes:
    """Sends pictures, and keeps what comes back."""

    def __init__(self, probe: Probe) -> None:
        from codesign_nodes import qos
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
        from sensor_msgs.msg import CameraInfo, CompressedImage

        self.probe = probe
        self._kind = CompressedImage
        self._images = probe.node.create_publisher(
            CompressedImage, "/camera/image/compressed", qos.IMAGE_OFFERED
        )
        self._info = probe.node.create_publisher(CameraInfo, "/camera/camera_info", qos.LATCHED)
        self._info.publish(CameraInfo(**CAMERA.to_info()))
        probe.listen("/object_pose", PoseStamped, qos.EVERY)
        probe.listen(
            "/tofu_pose_estimator/pose_with_covariance", PoseWithCovarianceStamped, qos.EVERY
        )
        probe.listen("/tofu_pose_estimator/debug/compressed", CompressedImage, qos.EVERY)
        probe.listen("/diagnostics", DiagnosticArray, qos.EVERY)
        probe.wait_for(
            lambda: probe.node.count_subscribers("/camera/image/compressed"), 60.0, "the estimator"
        )

    def send(self, data: bytes) -> Any:
        message = self._kind(format="jpeg")
        message.data.frombytes(data)
        message.header.stamp = self.probe.node.get_clock().now().to_msg()
        self._images.publish(message)
        return message.header.stamp

    def poses(self) -> list[Any]:
        return [m for _, m in self.probe.received["/object_pose"]]

    def answered(self, stamp: Any) -> Any:
        return next((m for m in self.poses() if m.header.stamp == stamp), None)

    def values(self) -> dict[str, str]:
        for _, array in reversed(self.probe.received["/diagnostics"]):
            for status in array.status:
                if status.name == "/tofu_pose_estimator":
                    told = {v.key: v.value for v in status.values}
                    return told | {"message": status.message, "level": status.level}
        return {}


def tofu(seed: int) -> bytes:
    image = synthetic.blank(CAMERA)
    synthetic.draw_box(image, CAMERA, TRUTH)
    return encode(synthetic.finished(image, np.random.default_rng(seed), blur=0.7, noise=3.0))


def start(graph: Graph, tmp_path: Path, **parameters: Any) -> Path:
    path = tmp_path / "camera.yaml"
    save_camera(path, CAMERA)
    defaults = {"camera_file": str(path), "sag": 0.0, "max_image_age": 5.0}
    graph.start("tofu_pose_estimator", defaults | parameters)
    return path


def test_poses_are_stamped_like_their_pictures(probe: Probe, graph: Graph, tmp_path: Path) -> None:
    start(graph, tmp_path)
    eyes = Eyes(probe)
    stamps: list[Any] = []

    def found() -> Any:
        stamps.append(eyes.send(tofu(len(stamps))))
        return probe.poll(lambda: eyes.answered(stamps[-1]), 3.0)

    pose = probe.wait_for(found, 60.0, "a pose")
    assert pose.header.frame_id == "link_base"
    p, q = pose.pose.position, pose.pose.orientation
    assert np.linalg.norm([p.x, p.y, p.z] - TRUTH[:3]) < 0.001
    assert 2.0 * np.arctan2(q.z, q.w) == pytest.approx(TRUTH[3], abs=np.radians(1.0))
    topic = "/tofu_pose_estimator/pose_with_covariance"
    probe.wait_for(lambda: probe.received[topic], 5.0, "a covariance")
    covariance = np.reshape(probe.latest(topic).pose.covariance, (6, 6))
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    assert 1e-6 < np.sqrt(covariance[0, 0]) < 1e-3
    debug = "/tofu_pose_estimator/debug/compressed"
    probe.wait_for(lambda: probe.received[debug], 5.0, "a debug picture")
    assert decode(bytes(probe.latest(debug).data)).shape == (360, 640, 3)


def test_bad_pictures_are_refused_and_counted(probe: Probe, graph: Graph, tmp_path: Path) -> None:
    """Empty, cut off, without a block, and a camera that hangs: silence, and the reason told."""
    start(graph, tmp_path)
    eyes = Eyes(probe)
    seeds = iter(range(1000, 2000))

    def found() -> Any:
        stamp = eyes.send(tofu(next(seeds)))
        return probe.poll(lambda: eyes.answered(stamp), 3.0)

    probe.wait_for(found, 60.0, "a pose")

    def counted(key: str, data: bytes) -> None:
        before = int(eyes.values().get(key, 0))
        stamp = eyes.send(data)
        probe.wait_for(lambda: int(eyes.values().get(key, 0)) > before, 10.0, key)
        assert eyes.answered(stamp) is None

    probe.wait_for(eyes.values, 10.0, "diagnostics")
    counted("empty", b"")
    counted("corrupt", tofu(1)[:5000])
    blank = synthetic.finished(synthetic.blank(CAMERA), np.random.default_rng(5), noise=3.0)
    counted("without_block", encode(blank))
    assert "nothing as bright" in eyes.values()["message"]
    same = tofu(7)
    stamps = []
    for _ in range(3):
        stamps.append(eyes.send(same))
        probe.poll(lambda: eyes.answered(stamps[-1]), 2.0)
    assert eyes.answered(stamps[2]) is None
    probe.wait_for(lambda: "equal pictures" in eyes.values()["message"], 5.0, "frozen camera")
    assert eyes.values()["level"] == b"\x02"


def test_calibrates_from_the_board_in_view(probe: Probe, graph: Graph, tmp_path: Path) -> None:
    from std_srvs.srv import Trigger

    wrong = CAMERA.moved(CAMERA.position + np.array([0.01, -0.005, 0.004]), CAMERA.quaternion)
    path = start(graph, tmp_path, **{"board.x": BOARD_AT[0], "board.y": BOARD_AT[1]})
    save_camera(path, wrong)
    eyes = Eyes(probe)

    def answer(data: bytes) -> Any:
        before = int(eyes.values().get("pictures", 0))
        eyes.send(data)
        probe.poll(lambda: int(eyes.values().get("pictures", 0)) > before, 3.0)
        return probe.call("/tofu_pose_estimator/calibrate", Trigger, Trigger.Request())

    refused = answer(tofu(0))
    assert not refused.success
    assert "board" in refused.message
    done = answer(encode(board_picture(), 98))
    assert done.success, done.message
    assert np.linalg.norm(load_camera(path).position - CAMERA.position) < 0.002


def board_picture() -> np.ndarray:
    """The default board lying on the table, warped by its homography; BGR."""
    board = CharucoBoard()
    pattern = cv2.GaussianBlur(board.picture(60), (0, 0), 0.8)
    height, width = pattern.shape
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    w, h = board.size
    flat = np.array([[-w, h, 0], [w, h, 0], [w, -h, 0], [-w, -h, 0]]) / 2.0
    pose = flat_pose(BOARD_AT, 0.0)
    seen = CAMERA.project(flat @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    turn = cv2.getPerspectiveTransform(pixels, seen)
    picture = cv2.warpPerspective(pattern, turn, (CAMERA.width, CAMERA.height), borderValue=150)
    return cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)


def test_a_video_file_as_a_camera(probe: Probe, graph: Graph, tmp_path: Path) -> None:
    from codesign_nodes import qos
    from sensor_msgs.msg import CameraInfo, CompressedImage

    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (320, 240))
    for level in range(20, 220, 20):
        writer.write(np.full((240, 320, 3), level, dtype=np.uint8))
    writer.release()
    small = Camera.looking_at([1, 0, 1], [0.4, 0, 0], width=320, height=240)
    save_camera(tmp_path / "camera.yaml", small)
    probe.listen("/camera/image/compressed", CompressedImage, qos.EVERY)
    probe.listen("/camera/camera_info", CameraInfo, qos.LATCHED)
    graph.start(
        "usb_camera",
        {
            "device": str(path), "width": 320, "height": 240, "rate": 20.0,
            "camera_file": str(tmp_path / "camera.yaml"),
        },
    )  # fmt: skip
    images = probe.received["/camera/image/compressed"]
    probe.wait_for(lambda: len(images) > 12, 60.0, "pictures, past the end of the file")
    levels = [decode(bytes(m.data)).mean() for _, m in images]
    assert np.ptp(levels) > 100.0
    assert Camera.from_info(
        *(getattr(probe.latest("/camera/camera_info"), n) for n in ("width", "height", "k", "d"))
    ).same_lens(small)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for _, m in images]
    assert (np.diff(stamps) > 0.0).all()
