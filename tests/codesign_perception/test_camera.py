"""The camera model against geometry worked out by hand."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from codesign_perception.camera import Camera
from codesign_perception.camera_file import CameraFile, Record, load_camera, save_camera

DISTORTION = np.array([-0.12, 0.05, 0.001, -0.0008, 0.01])


@pytest.fixture
def camera() -> Camera:
    return Camera.looking_at(
        [0.9, -0.45, 0.5], [0.45, 0.0, 0.02], focal=1100.0, distortion=DISTORTION
    )


def test_target_appears_in_the_middle_and_up_is_up() -> None:
    camera = Camera.looking_at([1.0, 0.0, 0.5], [0.5, 0.0, 0.0], fov=math.radians(60.0))
    middle, above, left = camera.project([[0.5, 0.0, 0.0], [0.5, 0.0, 0.01], [0.5, -0.01, 0.0]])
    np.testing.assert_allclose(middle, [639.5, 359.5], atol=1e-9)
    assert above[1] < middle[1]
    # Looking along -x, +y is to the right.
    assert left[0] < middle[0]


def test_looking_straight_down() -> None:
    camera = Camera.looking_at(
        [0.5, 0.0, 1.0], [0.5, 0.0, 0.0], focal=1000.0, width=801, height=601
    )
    np.testing.assert_allclose(camera.project([[0.5, 0.0, 0.0]]), [[400.0, 300.0]], atol=1e-9)
    # 10 mm towards +x at 1 m is 10 px up.
    np.testing.assert_allclose(camera.project([[0.51, 0.0, 0.0]]), [[400.0, 290.0]], atol=1e-9)


def test_projection_by_hand_with_distortion() -> None:
    matrix = np.array([[1000.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]])
    k1, k2, p1, p2, k3 = DISTORTION
    camera = Camera(1280, 720, matrix, DISTORTION)
    x, y = 0.2, -0.1
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    expected = [[1000.0 * u + 640.0, 900.0 * v + 360.0]]
    np.testing.assert_allclose(camera.project([[0.4, -0.2, 2.0]]), expected, atol=1e-9)


def test_rays_undo_the_projection(camera: Camera) -> None:
    rng = np.random.default_rng(0)
    points = np.array([0.45, 0.0, 0.05]) + rng.uniform(-0.1, 0.1, (50, 3))
    origin, directions = camera.rays(camera.project(points))
    away = points - origin
    expected = away / np.linalg.norm(away, axis=1, keepdims=True)
    np.testing.assert_allclose(directions, expected, atol=1e-8)
    flat = np.column_stack([points[:, :2], np.full(50, 0.01)])
    np.testing.assert_allclose(camera.on_plane(camera.project(flat), 0.01), flat, atol=1e-8)


def test_points_behind_the_camera_are_nan(camera: Camera) -> None:
    behind = 2 * camera.position - np.array([0.45, 0.0, 0.02])
    assert np.isnan(camera.project([behind])).all()


def test_camera_info_there_and_back(camera: Camera) -> None:
    info = camera.to_info()
    again = Camera.from_info(
        info["width"], info["height"], info["k"], info["d"], info["distortion_model"],
        position=camera.position, quaternion=camera.quaternion,
    )  # fmt: skip
    assert again.same_lens(camera)
    with pytest.raises(ValueError, match="calibrate the camera first"):
        Camera.from_info(1280, 720, [0.0] * 9, [])
    with pytest.raises(ValueError, match="equidistant"):
        Camera.from_info(1280, 720, info["k"], [0.1] * 4, "equidistant")


def test_file_there_and_back(camera: Camera, tmp_path: Path) -> None:
    path = tmp_path / "new" / "camera.yaml"
    save_camera(path, camera)
    again = load_camera(path)
    for name in ("matrix", "distortion", "position", "quaternion"):
        np.testing.assert_allclose(getattr(again, name), getattr(camera, name), atol=1e-15)
    assert CameraFile.load(path).extrinsics.method == "simulated"


def test_a_file_without_extrinsics_says_what_to_do(camera: Camera, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    CameraFile(camera, Record.now("charuco", 0.3, 20)).save(path)
    assert CameraFile.load(path).intrinsics.reprojection_error_px == 0.3
    with pytest.raises(ValueError, match="calibrate extrinsics"):
        load_camera(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("image"), "'?image'? is missing"),
        (lambda c: c["intrinsics"].pop("matrix"), "matrix is missing"),
        (lambda c: c["intrinsics"].update(distortion=[0.0]), r"distortion has shape \(1,\)"),
        (lambda c: c["intrinsics"].update(distortion_model="fisheye"), "fisheye"),
        (lambda c: c["intrinsics"].update(reprojection_error_px=-1), "reprojection_error_px"),
        (lambda c: c["extrinsics"].update(quaternion_xyzw=[0, 0, 0, 2]), "length 2"),
        (lambda c: c["extrinsics"].update(position_m=[0, 0, float("nan")]), "must be finite"),
        (lambda c: c["extrinsics"].update(parent="world"), "link_base"),
        (lambda c: c["image"].update(width=3), "camera width 3 px"),
    ],
)
def test_bad_files_are_refused(camera: Camera, tmp_path: Path, change, message) -> None:
    path = tmp_path / "camera.yaml"
    save_camera(path, camera)
    content = yaml.safe_load(path.read_text())
    change(content)
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ValueError, match=message) as caught:
        load_camera(path)
    assert str(path) in str(caught.value)


def test_rubbish_is_no_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    for text in ("", "- 1", "{", "\x00"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"camera\.yaml"):
            load_camera(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width 0"),
        ({"matrix": np.eye(2)}, "shape"),
        ({"matrix": -np.eye(3)}, "focal"),
        ({"quaternion": np.zeros(4)}, "length 0"),
        ({"distortion": np.full(5, np.inf)}, "finite"),
    ],
)
def test_impossible_cameras_are_refused(camera: Camera, change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(camera, **change)


def test_vertical_field_of_view() -> None:
    camera = Camera.looking_at([0, 0, 1], [1, 0, 0], focal=1000.0)
    assert camera.vertical_fov == pytest.approx(2 * math.atan(360 / 1000))
