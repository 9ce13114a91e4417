"""`codesign perception`, from files to files."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from codesign_cli.main import app
from codesign_cli.perception_bench import run_bench
from codesign_perception.board import CharucoBoard
from codesign_perception.calibration import flat_pose
from codesign_perception.camera import Camera
from codesign_perception.camera_file import CameraFile, Record, load_camera, save_camera

from . import synthetic

CAMERA = Camera.looking_at([0.78, 0.06, 0.30], [0.45, 0.0, 0.03], focal=1000.0)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["perception", *map(str, arguments)])


def drawn_board(pose: np.ndarray) -> np.ndarray:
    """The board at a (4, 4) pose through CAMERA, by its homography; grey."""
    board = CharucoBoard()
    pattern = cv2.GaussianBlur(board.picture(60), (0, 0), 0.8)
    height, width = pattern.shape
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32) - 0.5
    w, h = board.size
    flat = np.array([[-w, h, 0], [w, h, 0], [w, -h, 0], [-w, -h, 0]]) / 2.0
    seen = CAMERA.project(flat @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    turn = cv2.getPerspectiveTransform(pixels, seen)
    return cv2.warpPerspective(pattern, turn, (CAMERA.width, CAMERA.height), borderValue=150)


def tilted(rng: np.random.Generator) -> np.ndarray:
    """All of the board in view, (4, 4)."""
    pose = np.eye(4)
    pixel = rng.uniform([0.4, 0.4], [0.6, 0.6]) * [CAMERA.width, CAMERA.height]
    origin, rays = CAMERA.rays([pixel])
    pose[:3, 3] = origin + rays[0] * rng.uniform(0.35, 0.5)
    turn = Rotation.from_euler("zyx", rng.uniform(-0.6, 0.6, 3)).as_matrix()
    pose[:3, :3] = (CAMERA.rotation * [1, -1, -1]) @ turn
    return pose


def test_estimate(tmp_path: Path) -> None:
    truth = np.array([0.46, 0.01, 0.02, 0.3])
    camera, image = tmp_path / "camera.yaml", tmp_path / "block.png"
    save_camera(camera, CAMERA)
    cv2.imwrite(str(image), synthetic.tofu_image(CAMERA, truth, blur=0.7, noise=3.0))
    debug = tmp_path / "debug.png"
    result = run("estimate", image, "--camera", camera, "--sag", 0, "--debug", debug, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.output)
    assert told["detected"]
    assert np.linalg.norm(told["position_m"] - truth[:3]) < 0.0005
    assert told["yaw_rad"] == pytest.approx(truth[3], abs=0.01)
    assert told["score"] > 0.9
    assert cv2.imread(str(debug)).shape == (720, 1280, 3)
    blank = synthetic.finished(synthetic.blank(CAMERA), np.random.default_rng(0), noise=3.0)
    cv2.imwrite(str(image), blank)
    result = run("estimate", image, "--camera", camera, "--json")
    assert result.exit_code == 1
    told = json.loads(result.output)
    assert (told["detected"], told["position_m"]) == (False, None)
    assert "nothing as bright" in told["reason"]
    image.write_text("no picture")
    result = run("estimate", image, "--camera", camera)
    assert result.exit_code == 2
    assert "no picture that OpenCV can read" in result.stderr


def test_board_to_print(tmp_path: Path) -> None:
    """The drawing holds the board that is looked for; the PDF has the page's true size."""
    assert run("board", "--out", tmp_path / "board.png").exit_code == 0
    picture = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert (
        len(CharucoBoard().find(cv2.copyMakeBorder(picture, *[99] * 4, 0, value=255)).points) == 40
    )
    assert run("board", "--out", tmp_path / "board.pdf").exit_code == 0
    points = 72 / 0.0254
    content = (tmp_path / "board.pdf").read_bytes()
    box = content.split(b"/MediaBox [")[1].split(b"]")[0].split()
    assert float(box[2]) == pytest.approx(0.294 * points, abs=0.1)
    assert float(box[3]) == pytest.approx(0.204 * points, abs=0.1)
    assert run("board", "--out", tmp_path / "board.gif").exit_code == 2


def test_lens_then_place(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    images = []
    for i in range(10):
        images.append(tmp_path / f"lens{i}.png")
        cv2.imwrite(str(images[-1]), drawn_board(tilted(rng)))
    lens, camera = tmp_path / "lens.yaml", tmp_path / "camera.yaml"
    result = run("calibrate", "intrinsics", *images, "--out", lens, "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.output)
    assert told["reprojection_error_px"] < 0.2
    np.testing.assert_allclose(told["focal_px"], 1000.0, rtol=0.003)
    table = tmp_path / "table.png"
    cv2.imwrite(str(table), drawn_board(flat_pose((0.45, 0.02, 0.0), np.radians(20.0))))
    place = ("--camera", lens, "--out", camera, "--position", 0.45, 0.02, 0.0)
    result = run("calibrate", "extrinsics", table, *place, "--yaw", 20, "--json")
    assert result.exit_code == 0, result.output
    assert np.linalg.norm(load_camera(camera).position - CAMERA.position) < 0.003
    assert CameraFile.load(camera).extrinsics.images == 1
    result = run("calibrate", "intrinsics", *images[:4], "--out", tmp_path / "no.yaml")
    assert result.exit_code == 1
    assert "at least 8 are needed" in result.stderr
    assert not (tmp_path / "no.yaml").exists()


def test_hand_eye_from_a_file_of_postures(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    mount = np.eye(4)
    mount[:3, 3] = [0.01, -0.02, 0.06]
    entries = []
    for i in range(8):
        board = tilted(rng)
        cv2.imwrite(str(tmp_path / f"{i}.png"), drawn_board(board))
        flange = board @ np.linalg.inv(mount)
        quaternion = Rotation.from_matrix(flange[:3, :3]).as_quat().tolist()
        entries.append(
            {
                "image": f"{i}.png",
                "flange_position_m": flange[:3, 3].tolist(),
                "flange_quaternion_xyzw": quaternion,
            }
        )
    poses, lens, out = tmp_path / "poses.json", tmp_path / "lens.yaml", tmp_path / "camera.yaml"
    poses.write_text(json.dumps({"poses": entries}))
    CameraFile(CAMERA, Record.now("charuco")).save(lens)
    result = run(
        "calibrate", "hand-eye", "--poses", poses, "--camera", lens, "--out", out, "--json"
    )
    assert result.exit_code == 0, result.output
    assert np.linalg.norm(load_camera(out).position - CAMERA.position) < 0.002
    np.testing.assert_allclose(
        json.loads(result.output)["board_on_flange_m"], mount[:3, 3], atol=2e-3
    )
    del entries[3]["flange_position_m"]
    poses.write_text(json.dumps({"poses": entries}))
    result = run("calibrate", "hand-eye", "--poses", poses, "--camera", lens, "--out", out)
    assert result.exit_code == 2
    assert "poses[3]" in result.stderr


def test_bench_in_small() -> None:
    """Two rendered pictures and one without a block; the full one is a command."""
    result = run_bench(images=2, empty=1, seed=3)
    assert result["true_detected"] == result["calibrated_detected"] == 1.0
    assert result["true_position_p95_m"] < 0.0007
    assert result["calibrated_position_p95_m"] < 0.0015
    assert result["true_yaw_p95_rad"] < np.radians(1.0)
    assert result["false_positives"] == 0
