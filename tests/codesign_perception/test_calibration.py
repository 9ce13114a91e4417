"""Calibration from boards that are drawn through a known camera."""

import functools

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from codesign_perception.board import CharucoBoard, View
from codesign_perception.calibration import (
    CalibrationError,
    calibrate_extrinsics,
    calibrate_hand_eye,
    calibrate_intrinsics,
    flat_pose,
    reprojection_error,
)
from codesign_perception.camera import Camera

BOARD = CharucoBoard()
TRUE = Camera.looking_at(
    [0.85, -0.1, 0.4], [0.45, 0.0, 0.0], focal=1000.0, distortion=[-0.1, 0.03, 0.001, -0.0005, 0.0]
)
PER_SQUARE = 60


def board_picture(pose: np.ndarray) -> np.ndarray:
    """The board at a (4, 4) pose, every pixel looked up in its plane; grey."""
    origin, rays = _rays()
    inverse = np.linalg.inv(pose)
    start, along = inverse[:3, :3] @ origin + inverse[:3, 3], rays @ inverse[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        places = start + along * (-start[2] / along[:, 2])[:, None]
    width, height = BOARD.size
    # Half a pattern pixel: OpenCV looks up centres. Blurred first, as rays are samples.
    x = (places[:, 0] + width / 2) / BOARD.square * PER_SQUARE - 0.5
    y = (height / 2 - places[:, 1]) / BOARD.square * PER_SQUARE - 0.5
    pattern = cv2.GaussianBlur(BOARD.picture(PER_SQUARE), (0, 0), 0.8)
    maps = [m.reshape(TRUE.height, TRUE.width).astype(np.float32) for m in (x, y)]
    return cv2.remap(pattern, *maps, cv2.INTER_LINEAR, borderValue=150)


@functools.cache
def _rays() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[0 : TRUE.height, 0 : TRUE.width]
    return TRUE.rays(np.column_stack([u.ravel(), v.ravel()]).astype(float))


def seen(pose: np.ndarray, rng: np.random.Generator, noise: float = 0.05) -> View:
    """Exact corners with noise [px]: what detection gives, without drawing."""
    world = BOARD.corners @ pose[:3, :3].T + pose[:3, 3]
    pixels = TRUE.project(world) + rng.normal(0.0, noise, (len(world), 2))
    inside = ((pixels > 0) & (pixels < [TRUE.width - 1, TRUE.height - 1])).all(axis=1)
    return View(BOARD.corners[inside], pixels[inside])


def tilted(rng: np.random.Generator) -> np.ndarray:
    """A board in view of the camera, (4, 4)."""
    pose = np.eye(4)
    pixel = rng.uniform([0.3, 0.3], [0.7, 0.7]) * [TRUE.width, TRUE.height]
    origin, rays = TRUE.rays([pixel])
    pose[:3, 3] = origin + rays[0] * rng.uniform(0.35, 0.6)
    tilt = Rotation.from_euler("zyx", rng.uniform(-0.6, 0.6, 3)).as_matrix()
    pose[:3, :3] = (TRUE.rotation * [1, -1, -1]) @ tilt
    return pose


def test_corners_are_found_where_the_board_was_drawn() -> None:
    pose = flat_pose((0.45, 0.02, 0.0), 0.3)
    view = BOARD.find(board_picture(pose))
    assert len(view.points) > 30
    assert reprojection_error(TRUE, view.points @ pose[:3, :3].T + pose[:3, 3], view.pixels) < 0.15


def test_place_of_the_camera_from_one_drawn_board() -> None:
    pose = flat_pose((0.45, 0.02, 0.0), 0.3)
    found = calibrate_extrinsics([BOARD.find(board_picture(pose))], [pose], TRUE)
    assert np.linalg.norm(found.camera.position - TRUE.position) < 0.001
    turn = Rotation.from_quat(found.camera.quaternion).inv() * Rotation.from_quat(TRUE.quaternion)
    assert turn.magnitude() < np.radians(0.1)
    # What counts: where a point of the table seems to be.
    place = found.camera.on_plane(TRUE.project([[0.45, 0.0, 0.02]]), 0.02)[0]
    assert np.linalg.norm(place - [0.45, 0.0, 0.02]) < 0.0003


def test_lens_from_tilted_views() -> None:
    rng = np.random.default_rng(0)
    views = [seen(tilted(rng), rng) for _ in range(14)]
    found = calibrate_intrinsics(views, TRUE.width, TRUE.height)
    np.testing.assert_allclose(found.camera.matrix, TRUE.matrix, atol=2.0)
    assert found.error < 0.1
    pixels = rng.uniform([100, 100], [1180, 620], (50, 2))
    off = (found.camera.normalized(pixels) - TRUE.normalized(pixels)) * 1000.0
    assert np.abs(off).max() < 1.5


def test_lens_is_refused() -> None:
    rng = np.random.default_rng(0)
    views = [seen(tilted(rng), rng) for _ in range(10)]
    with pytest.raises(CalibrationError, match=r"7 pictures, at least 8"):
        calibrate_intrinsics(views[:7], TRUE.width, TRUE.height)
    noisy = [seen(tilted(rng), rng, noise=3.0) for _ in range(10)]
    with pytest.raises(CalibrationError, match=r"at most 0\.70"):
        calibrate_intrinsics(noisy, TRUE.width, TRUE.height)
    facing = np.eye(4)
    facing[:3, 3] = TRUE.position + 0.5 * TRUE.rotation[:, 2]
    facing[:3, :3] = TRUE.rotation * [1, -1, -1]
    alike = [seen(facing, rng, noise=0.3) for _ in range(10)]
    with pytest.raises(CalibrationError, match="tilted by 15 degrees"):
        calibrate_intrinsics(alike, TRUE.width, TRUE.height, max_error=5.0)


def test_place_is_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(CalibrationError, match="found in no picture"):
        calibrate_extrinsics([], [], TRUE)
    poses = [flat_pose((0.45, 0.0, 0.0), 0.0), flat_pose((0.45, 0.05, 0.0), 0.0)]
    views = [seen(pose, rng) for pose in poses]
    wrong = [poses[0], flat_pose((0.45, 0.07, 0.0), 0.0)]
    with pytest.raises(CalibrationError, match="where it was said to be"):
        calibrate_extrinsics(views, wrong, TRUE)


def postures(rng: np.random.Generator, mount: np.ndarray, count: int, tilt: float) -> list:
    """(flange pose, board pose) with the board in view."""
    pairs = []
    for _ in range(count):
        board = tilted(rng)
        turn = Rotation.from_euler("zyx", rng.uniform(-tilt, tilt, 3)).as_matrix()
        board[:3, :3] = (TRUE.rotation * [1, -1, -1]) @ turn
        pairs.append((board @ np.linalg.inv(mount), board))
    return pairs


def test_hand_eye() -> None:
    rng = np.random.default_rng(3)
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_euler("xyz", [0.1, -0.2, 1.0]).as_matrix()
    mount[:3, 3] = [0.02, -0.03, 0.05]
    pairs = postures(rng, mount, 12, 0.5)
    views = [seen(board, rng) for _, board in pairs]
    found, board_on_flange = calibrate_hand_eye(views, [f for f, _ in pairs], TRUE)
    assert found.error < 0.1
    assert np.linalg.norm(found.camera.position - TRUE.position) < 0.0005
    np.testing.assert_allclose(board_on_flange, mount, atol=1e-3)


def test_hand_eye_is_refused() -> None:
    rng = np.random.default_rng(3)
    mount = np.eye(4)
    pairs = postures(rng, mount, 8, 0.5)
    views = [seen(board, rng) for _, board in pairs]
    flange = [f for f, _ in pairs]
    with pytest.raises(CalibrationError, match="at least 6"):
        calibrate_hand_eye(views[:5], flange[:5], TRUE)
    shifted = [f.copy() for f in flange]
    shifted[3][:3, 3] += [0.02, 0.0, 0.0]
    with pytest.raises(CalibrationError, match="joint angle"):
        calibrate_hand_eye(views, shifted, TRUE)
    alike = postures(rng, mount, 8, 0.01)
    with pytest.raises(CalibrationError, match="second axis"):
        calibrate_hand_eye([seen(b, rng) for _, b in alike], [f for f, _ in alike], TRUE)


def test_impossible_boards_are_refused() -> None:
    with pytest.raises(ValueError, match="squares"):
        CharucoBoard(columns=2)
    with pytest.raises(ValueError, match="marker"):
        CharucoBoard(marker=0.04)
