"""Node usb_camera: a camera or a video file, read by OpenCV, as compressed pictures.

Any driver that publishes the same two topics does as well.
"""

import threading
import time
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import CameraInfo, CompressedImage

from codesign_nodes import qos
from codesign_nodes.node_tools import Diagnostics, LeanNode, declare, run
from codesign_perception.camera import FRAME
from codesign_perception.camera_file import CameraFile
from codesign_perception.frames import encode

RETRY = 1.0  # s until a camera that is gone is tried again


class UsbCamera(LeanNode):
    """Publishes /camera/image/compressed, and /camera/camera_info of a calibrated camera."""

    def __init__(self) -> None:
        super().__init__("usb_camera")
        if self.get_parameter("use_sim_time").value:
            raise ValueError("use_sim_time is set: a camera runs in real time, leave it out")
        self._device = declare(
            self, "device", "0", "number of the camera, its path, or a video file"
        )
        self._width = declare(self, "width", 1280, "of the pictures [px]", low=16, high=7680)
        self._height = declare(self, "height", 720, "of the pictures [px]", low=16, high=4320)
        self._rate = declare(self, "rate", 30.0, "pictures per second", low=0.5, high=120.0)
        self._quality = declare(self, "quality", 90, "of the JPEG pictures", low=30, high=100)
        self._exposure = declare(
            self, "exposure", -1.0, "fixed exposure in the driver's units; -1: leave it",
            low=-1.0, high=1e6,
        )  # fmt: skip
        self._loop = declare(self, "loop", True, "start a video file again at its end")
        path = declare(self, "camera_file", "", "YAML file of the camera; empty: not calibrated")
        self._file = CameraFile.load(path) if path else None
        self._check_size()
        self._image_pub = self.create_publisher(
            CompressedImage, "/camera/image/compressed", qos.IMAGE_OFFERED
        )
        self._info_pub = self.create_publisher(CameraInfo, "/camera/camera_info", qos.LATCHED)
        self._publish_info()
        self._pictures, self._failures = 0, 0
        self._message = "opening"
        self._reported, self._report_at = 0, time.monotonic()
        self._stopping = threading.Event()
        cv2.setNumThreads(1)
        self._diagnostics = Diagnostics(self, self._report)
        # Reading waits for the camera, so it has a thread; nothing else happens there.
        self._thread = threading.Thread(target=self._capture, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the capture."""
        self._stopping.set()
        self._thread.join(2.0)

    def _check_size(self) -> None:
        if self._file is None:
            return
        camera = self._file.camera
        if (camera.width, camera.height) != (self._width, self._height):
            raise ValueError(
                f"camera_file is for {camera.width} x {camera.height} px, parameters ask for "
                f"{self._width} x {self._height}: use the size that was calibrated"
            )

    def _publish_info(self) -> None:
        if self._file is None:
            return
        info = CameraInfo(**self._file.camera.to_info())
        info.header.stamp = self.get_clock().now().to_msg()
        info.header.frame_id = FRAME
        self._info_pub.publish(info)

    # --- capture, in its own thread

    def _capture(self) -> None:
        while not self._stopping.is_set():
            source = self._opened()
            if source is None:
                self._stopping.wait(RETRY)
                continue
            self._read(source)
            source.release()

    def _opened(self) -> cv2.VideoCapture | None:
        device: Any = int(self._device) if self._device.isdigit() else self._device
        source = cv2.VideoCapture(device)
        if not source.isOpened():
            self._fail(f"cannot open {self._device}: is it plugged in, and may you read it?")
            return None
        if isinstance(device, int) or self._device.startswith("/dev/"):
            source.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*"MJPG"))
            source.set(cv2.CAP_PROP_FRAME_WIDTH, self._width)
            source.set(cv2.CAP_PROP_FRAME_HEIGHT, self._height)
            source.set(cv2.CAP_PROP_FPS, self._rate)
            source.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            if self._exposure >= 0.0:
                source.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1)  # V4L2: manual
                source.set(cv2.CAP_PROP_EXPOSURE, self._exposure)
        return source

    def _read(self, source: cv2.VideoCapture) -> None:
        """Until it ends or fails."""
        period, due = 1.0 / self._rate, time.monotonic()
        while not self._stopping.is_set():
            done, image = source.read()
            stamp = self.get_clock().now().to_msg()
            if not done:
                if self._rewound(source):
                    continue
                self._fail(f"{self._device} gives no picture: unplugged, or the video has ended")
                self._stopping.wait(RETRY)
                return
            if image.shape[:2] != (self._height, self._width):
                height, width = image.shape[:2]
                self._fail(
                    f"{self._device} gives {width} x {height} px instead of {self._width} x "
                    f"{self._height}: set width and height to what it can"
                )
                self._stopping.wait(RETRY)
                return
            self._publish(image, stamp)
            due = max(due + period, time.monotonic() - period)
            self._stopping.wait(max(due - time.monotonic(), 0.0))

    def _rewound(self, source: cv2.VideoCapture) -> bool:
        frames = source.get(cv2.CAP_PROP_FRAME_COUNT)
        at = source.get(cv2.CAP_PROP_POS_FRAMES)
        return bool(self._loop and frames > 0 and at > 0 and source.set(cv2.CAP_PROP_POS_FRAMES, 0))

    def _publish(self, image: Any, stamp: Any) -> None:
        message = CompressedImage(format="bgr8; jpeg compressed bgr8")
        message.data.frombytes(encode(image, self._quality))
        message.header.stamp = stamp
        message.header.frame_id = FRAME
        self._image_pub.publish(message)
        self._pictures += 1
        self._message = ""

    def _fail(self, message: str) -> None:
        self._failures += 1
        self._message = message
        self.get_logger().error(message, throttle_duration_sec=5.0)

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        now = time.monotonic()
        rate = (self._pictures - self._reported) / max(now - self._report_at, 1e-9)
        self._reported, self._report_at = self._pictures, now
        values = {
            "pictures": self._pictures,
            "pictures_per_second": round(rate, 1),
            "failures": self._failures,
            "calibrated": self._file is not None,
        }
        if self._message:
            return DiagnosticStatus.ERROR, self._message, values
        return DiagnosticStatus.OK, "running", values


def main() -> None:
    """Runs the node."""
    run(UsbCamera)
