"""The camera model: a pinhole with plumb-bob distortion at a known place in link_base.

Pixels are OpenCV's: u to the right, v down, (0, 0) is the *centre* of the first pixel, so the
image spans -0.5..width-0.5. The frame of the camera is `camera_color_optical_frame`: x right,
y down, z forward.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]

FRAME = "camera_color_optical_frame"
DISTORTION_MODEL = "plumb_bob"


@dataclass(frozen=True)
class Camera:
    """Intrinsics and extrinsics.

    Attributes:
        width, height: of the image [px].
        matrix: (3, 3) fx, fy, cx, cy [px]; no skew.
        distortion: (5,) k1, k2, p1, p2, k3 of the plumb-bob model, as in OpenCV.
        position: (3,) of camera_color_optical_frame in link_base [m].
        quaternion: (4,) x y z w of camera_color_optical_frame in link_base; normalised here.

    Raises:
        ValueError: a value that cannot be a camera's; the message names it.
    """

    width: int
    height: int
    matrix: Floats
    distortion: Floats = field(default_factory=lambda: np.zeros(5))
    position: Floats = field(default_factory=lambda: np.zeros(3))
    quaternion: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if int(size) != size or not 16 <= size <= 16384:
                raise ValueError(f"camera {name} {size} px: must be a whole number, 16 to 16384")
            object.__setattr__(self, name, int(size))
        shapes = {"matrix": (3, 3), "distortion": (5,), "position": (3,), "quaternion": (4,)}
        for name, shape in shapes.items():
            object.__setattr__(self, name, _array(name, getattr(self, name), shape))
        _check_matrix(self.matrix)
        norm = float(np.linalg.norm(self.quaternion))
        if not 0.99 < norm < 1.01:
            raise ValueError(f"camera quaternion has length {norm:.4g}: must be 1 (x, y, z, w)")
        object.__setattr__(self, "quaternion", self.quaternion / norm)

    @staticmethod
    def looking_at(
        position: ArrayLike,
        target: ArrayLike,
        *,
        width: int = 1280,
        height: int = 720,
        fov: float | None = None,
        focal: float | None = None,
        distortion: ArrayLike | None = None,
    ) -> Camera:
        """A level camera at `position` (3,) [m] whose optical axis meets `target` (3,) [m].

        Args:
            width, height: of the image [px].
            fov: horizontal field of view [rad], without distortion; 60 degrees if neither is given.
            focal: focal length [px], instead of `fov`.
            distortion: (5,); none if not given.
        """
        if fov is not None and focal is not None:
            raise ValueError("give fov or focal, not both")
        if focal is None:
            fov = math.radians(60.0) if fov is None else fov
            if not 0.0 < fov < math.pi:
                raise ValueError(f"fov {fov} rad: must be between 0 and pi")
            focal = width / 2.0 / math.tan(fov / 2.0)
        start = _array("position", position, (3,))
        forward = _array("target", target, (3,)) - start
        if np.linalg.norm(forward) < 1e-9:
            raise ValueError(f"camera looks at its own position {start.tolist()}")
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        if np.linalg.norm(right) < 1e-9:  # straight down or up: the image's top is then +x
            right = np.array([0.0, -1.0, 0.0]) if forward[2] < 0 else np.array([0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward], axis=1)
        center = ((width - 1) / 2.0, (height - 1) / 2.0)
        matrix = np.array([[focal, 0.0, center[0]], [0.0, focal, center[1]], [0.0, 0.0, 1.0]])
        lens = np.zeros(5) if distortion is None else np.asarray(distortion, dtype=np.float64)
        return Camera(width, height, matrix, lens, start, Rotation.from_matrix(axes).as_quat())

    # -- geometry

    @property
    def rotation(self) -> Floats:
        """(3, 3): columns are the camera's x, y, z axes in link_base."""
        return Rotation.from_quat(self.quaternion).as_matrix()

    @property
    def transform(self) -> Floats:
        """(4, 4) of camera_color_optical_frame in link_base."""
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = self.rotation, self.position
        return transform

    @property
    def vertical_fov(self) -> float:
        """Vertical field of view of the image without distortion [rad]."""
        (_, fy), (_, cy) = self._focal, self._center
        return math.atan((cy + 0.5) / fy) + math.atan((self.height - 0.5 - cy) / fy)

    def to_camera(self, points: ArrayLike) -> Floats:
        """(N, 3) points of link_base in the camera's frame [m]."""
        return (np.asarray(points, dtype=np.float64).reshape(-1, 3) - self.position) @ self.rotation

    def project(self, points: ArrayLike) -> Floats:
        """Where (N, 3) points of link_base [m] appear, (N, 2) [px]; NaN behind the camera.

        Pixels may lie outside the image.
        """
        local = self.to_camera(points)
        pixels = np.full((len(local), 2), np.nan)
        seen = local[:, 2] > 1e-6
        if seen.any():
            pixels[seen] = cv2.projectPoints(
                local[seen], np.zeros(3), np.zeros(3), self.matrix, self.distortion
            )[0][:, 0]
        return pixels

    def normalized(self, pixels: ArrayLike) -> Floats:
        """(N, 2) x / z, y / z in the camera's frame of (N, 2) pixels: distortion undone."""
        pixels = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        if not self.distortion.any():
            return (pixels[:, 0] - self._center) / self._focal
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 1e-10)
        flat: Floats = cv2.undistortPointsIter(
            pixels, self.matrix, self.distortion, np.eye(3), np.eye(3), criteria
        )[:, 0].astype(np.float64)
        return flat

    def rays(self, pixels: ArrayLike) -> tuple[Floats, Floats]:
        """Through (N, 2) pixels: common origin (3,) [m], unit directions (N, 3), in link_base."""
        flat = self.normalized(pixels)
        directions = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation.T
        return self.position.copy(), directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def on_plane(self, pixels: ArrayLike, height: float) -> Floats:
        """Where the rays of (N, 2) pixels meet z = `height`: (N, 3) [m]; NaN if they never do."""
        origin, directions = self.rays(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (height - origin[2]) / directions[:, 2]
        distance[~(distance > 0.0) | ~np.isfinite(distance)] = np.nan
        return origin + distance[:, None] * directions

    def undistorted(self) -> Camera:
        """The same camera without distortion."""
        return replace(self, distortion=np.zeros(5))

    def moved(self, position: ArrayLike, quaternion: ArrayLike) -> Camera:
        """The same lens at another place."""
        return replace(
            self,
            position=np.asarray(position, dtype=np.float64),
            quaternion=np.asarray(quaternion, dtype=np.float64),
        )

    # -- sensor_msgs/CameraInfo as plain values

    def to_info(self) -> dict[str, object]:
        """Fields of sensor_msgs/CameraInfo: width, height, distortion_model, d, k, r, p."""
        k = self.matrix
        projection = np.hstack([k, np.zeros((3, 1))])
        return {
            "width": self.width,
            "height": self.height,
            "distortion_model": DISTORTION_MODEL,
            "d": self.distortion.tolist(),
            "k": k.ravel().tolist(),
            "r": np.eye(3).ravel().tolist(),
            "p": projection.ravel().tolist(),
        }

    @staticmethod
    def from_info(
        width: int,
        height: int,
        k: Sequence[float],
        d: Sequence[float],
        model: str = DISTORTION_MODEL,
        *,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (0.0, 0.0, 0.0, 1.0),
    ) -> Camera:
        """From the fields of sensor_msgs/CameraInfo; fewer than 5 coefficients: the rest is 0.

        Raises:
            ValueError: another distortion model, or an uncalibrated camera (k is zero).
        """
        if len(d) and model != DISTORTION_MODEL:
            raise ValueError(f"distortion model {model!r}: only {DISTORTION_MODEL} is supported")
        if len(d) > 5:
            raise ValueError(f"distortion has {len(d)} coefficients: {DISTORTION_MODEL} has 5")
        if len(k) != 9 or k[0] == 0.0:
            raise ValueError("camera info has no intrinsics (k): calibrate the camera first")
        distortion = np.zeros(5)
        distortion[: len(d)] = d
        return Camera(
            width,
            height,
            np.reshape(np.asarray(k, dtype=np.float64), (3, 3)),
            distortion,
            np.asarray(position, dtype=np.float64),
            np.asarray(quaternion, dtype=np.float64),
        )

    def same_lens(self, other: Camera, tolerance: float = 1e-6) -> bool:
        """Whether size and intrinsics agree."""
        return (
            (self.width, self.height) == (other.width, other.height)
            and np.allclose(self.matrix, other.matrix, rtol=tolerance, atol=tolerance)
            and np.allclose(self.distortion, other.distortion, rtol=tolerance, atol=tolerance)
        )

    @property
    def _focal(self) -> Floats:
        return self.matrix[[0, 1], [0, 1]]

    @property
    def _center(self) -> Floats:
        return self.matrix[:2, 2]


def _array(name: str, value: object, shape: tuple[int, ...]) -> Floats:
    """`value` as a new array of this shape.

    Raises:
        ValueError: it is not one, or not finite; the message names it.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"camera {name}: not numbers") from error
    if array.shape != shape:
        raise ValueError(f"camera {name} has shape {array.shape}: must be {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"camera {name} {array.tolist()}: must be finite")
    return array


def _check_matrix(matrix: Floats) -> None:
    """Positive focal lengths, no skew, last row 0 0 1."""
    if matrix[0, 0] <= 0.0 or matrix[1, 1] <= 0.0:
        raise ValueError(f"camera matrix: focal lengths {matrix[0, 0]:.4g}, {matrix[1, 1]:.4g} px")
    expected = matrix.copy()
    expected[0, 1] = expected[1, 0] = 0.0
    expected[2] = [0.0, 0.0, 1.0]
    if not np.array_equal(matrix, expected):
        raise ValueError("camera matrix: must be fx 0 cx / 0 fy cy / 0 0 1")
