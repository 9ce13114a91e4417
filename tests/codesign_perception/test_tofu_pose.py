"""The block's pose in drawn pictures, whose truth is exact."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from codesign_perception.camera import Camera
from codesign_perception.config import EstimatorConfig
from codesign_perception.tofu_pose import Held, TofuPoseEstimator, wrapped

from . import synthetic

RIGID = EstimatorConfig(sag=0.0)
FINGER = np.array([107.0, 51.0, 26.0])


@pytest.fixture(scope="module")
def camera() -> Camera:
    cv2.setNumThreads(1)
    return Camera.looking_at(
        [0.78, 0.06, 0.30], [0.45, 0.0, 0.03], focal=1000.0,
        distortion=[-0.12, 0.05, 0.001, -0.0008, 0.01],
    )  # fmt: skip


def random_pose(rng: np.random.Generator, spread: float = 0.05) -> np.ndarray:
    x, y = np.array([0.45, 0.0]) + rng.uniform(-spread, spread, 2)
    return np.array([x, y, 0.02, rng.uniform(-np.pi / 2, np.pi / 2)])


@pytest.mark.parametrize(("blur", "noise", "limit"), [(0.0, 0.0, 0.12), (1.0, 4.0, 0.4)])
def test_resting_block(camera: Camera, blur: float, noise: float, limit: float) -> None:
    """Errors below `limit` mm and 1 degree in every one of 12 pictures."""
    rng = np.random.default_rng(1)
    for _ in range(12):
        truth = random_pose(rng)
        light = rng.uniform(0.8, 1.2)
        image = synthetic.tofu_image(camera, truth, blur=blur, noise=noise, light=light)
        pose = TofuPoseEstimator(camera, RIGID).estimate(image).pose
        assert pose is not None
        assert 1e3 * np.linalg.norm(pose.position - truth[:3]) < limit
        assert abs(np.degrees(wrapped(pose.yaw - truth[3]))) < 1.0
        assert pose.state == "resting"
        assert pose.score > 0.9
        np.testing.assert_allclose(pose.size, RIGID.size, atol=5e-4)


def test_covariance_is_honest(camera: Camera) -> None:
    """Errors of 12 noisy pictures are within 4 standard deviations, and not all tiny ones."""
    rng = np.random.default_rng(2)
    ratios = []
    for _ in range(12):
        truth = random_pose(rng)
        image = synthetic.tofu_image(camera, truth, blur=0.8, noise=6.0)
        pose = TofuPoseEstimator(camera, RIGID).estimate(image).pose
        error = np.array([*(pose.position - truth[:3]), wrapped(pose.yaw - truth[3])])
        ratios.append(np.abs(error) / np.sqrt(np.diag(pose.covariance)))
    assert np.max(ratios) < 4.0
    assert np.max(ratios) > 0.3


def test_half_turn_is_the_same_yaw(camera: Camera) -> None:
    yaws = []
    for yaw in (0.4, 0.4 + np.pi, 0.4 - np.pi):
        image = synthetic.tofu_image(camera, [0.45, 0.0, 0.02, yaw])
        yaws.append(TofuPoseEstimator(camera, RIGID).estimate(image).pose.yaw)
    np.testing.assert_allclose(yaws, 0.4, atol=0.005)
    assert wrapped(np.pi / 2) == -np.pi / 2
    assert wrapped(np.pi / 2 - 1e-6) == pytest.approx(np.pi / 2 - 1e-6)


def between_fingers(
    camera: Camera, pose: np.ndarray, size: tuple[float, float, float]
) -> np.ndarray:
    """A block squeezed along its y axis by two fingers."""
    image = synthetic.blank(camera)
    sides = [np.array([0.0, s * (size[1] / 2 + 0.008), 0.012, 0.0]) for s in (1, -1)]
    fingers = sorted(
        (pose + s for s in sides), key=lambda p: -np.linalg.norm(camera.position - p[:3])
    )
    synthetic.draw_box(image, camera, fingers[0], (0.02, 0.016, 0.06), FINGER)
    synthetic.draw_box(image, camera, pose, size)
    synthetic.draw_box(image, camera, fingers[1], (0.02, 0.016, 0.06), FINGER)
    return synthetic.finished(image, np.random.default_rng(0), blur=0.7, noise=3.0)


def test_lifted_block_by_the_hand_s_word(camera: Camera) -> None:
    """A squeezed block on its way up: 2 mm, with a hint that is 3 mm off sideways."""
    estimator = TofuPoseEstimator(camera, RIGID)
    truth = np.array([0.45, 0.0, 0.02, 0.0])
    assert estimator.estimate(synthetic.tofu_image(camera, truth, blur=0.7, noise=3.0)).pose
    for lift in (0.0, 0.005, 0.02, 0.05, 0.1):
        pose = truth + np.array([0.0, 0.0, lift, 0.0])
        image = between_fingers(camera, pose, (0.0512, 0.0273, 0.0405))
        found = estimator.estimate(image, Held(pose[:3] + np.array([0.003, -0.002, 0.0002]))).pose
        assert found is not None
        assert found.state == "held"
        assert np.linalg.norm(found.position - pose[:3]) < 0.002


def test_a_block_that_the_fingers_hide_by_half(camera: Camera) -> None:
    """A finger nearly as wide as the block before it: the picture alone does not tell its place,
    with the hand's word it does to 2 mm."""
    truth = np.array([0.45, 0.0, 0.02, 0.3])
    held = truth + np.array([0.0, 0.0, 0.1, 0.0])
    turned = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    image = synthetic.blank(camera)
    near = held.copy()
    near[:2] += turned @ np.array([0.024, 0.0])
    synthetic.draw_box(image, camera, held, (0.0512, 0.0273, 0.0405))
    synthetic.draw_box(image, camera, near, (0.012, 0.028, 0.06), FINGER)
    image = synthetic.finished(image, np.random.default_rng(0), blur=0.7, noise=3.0)
    estimator = TofuPoseEstimator(camera, RIGID)
    assert estimator.estimate(synthetic.tofu_image(camera, truth, blur=0.7, noise=3.0)).pose
    assert estimator.estimate(image).pose is None
    found = estimator.estimate(image, Held(held[:3] + np.array([0.0014, -0.0006, 0.0007])))
    assert found.pose is not None, found.reason
    assert found.score < RIGID.min_score
    assert np.linalg.norm(found.pose.position - held[:3]) < 0.002


def test_a_dropped_block_is_found_on_the_table(camera: Camera) -> None:
    """The hand goes up alone: what the picture shows decides."""
    estimator = TofuPoseEstimator(camera, RIGID)
    truth = np.array([0.45, 0.01, 0.02, 0.2])
    image = synthetic.tofu_image(camera, truth, blur=0.7, noise=3.0)
    assert estimator.estimate(image).pose
    found = estimator.estimate(image, Held(truth[:3] + np.array([0.0, 0.0, 0.08]))).pose
    assert found.state == "resting"
    assert np.linalg.norm(found.position - truth[:3]) < 0.0005


def test_off_the_table_without_a_hand(camera: Camera) -> None:
    """Nothing hovers: told only on request, and then with the uncertainty of its distance."""
    truth = np.array([0.45, 0.0, 0.08, 0.2])
    image = synthetic.tofu_image(camera, truth, blur=0.7, noise=3.0)
    detection = TofuPoseEstimator(camera, RIGID).estimate(image)
    assert detection.pose is None
    assert "no hand holds it" in detection.reason
    pose = TofuPoseEstimator(camera, replace(RIGID, allow_lifted=True)).estimate(image).pose
    assert pose.state == "lifted"
    assert np.linalg.norm(pose.position - truth[:3]) < 0.003
    assert 0.001 < np.sqrt(np.linalg.eigvalsh(pose.covariance[:3, :3]).max()) < 0.005


@pytest.mark.parametrize(
    ("size", "color"),
    [
        ((0.07, 0.03, 0.04), synthetic.TOFU),
        ((0.05, 0.03, 0.055), synthetic.TOFU),
        ((0.045, 0.045, 0.045), synthetic.TOFU),
        ((0.05, 0.03, 0.04), np.array([60.0, 60.0, 200.0])),
    ],
)
def test_other_boxes_are_refused(camera: Camera, size: tuple, color: np.ndarray) -> None:
    for yaw in (-1.0, 0.0, 0.7):
        image = synthetic.blank(camera)
        synthetic.draw_box(image, camera, np.array([0.45, 0.0, size[2] / 2, yaw]), size, color)
        image = synthetic.finished(image, np.random.default_rng(0), blur=0.7, noise=3.0)
        detection = TofuPoseEstimator(camera, RIGID).estimate(image)
        assert detection.pose is None
        assert detection.reason


def test_an_empty_table_and_a_dark_picture(camera: Camera) -> None:
    for image in (
        synthetic.finished(synthetic.blank(camera), np.random.default_rng(0), noise=4.0),
        np.zeros((camera.height, camera.width, 3), dtype=np.uint8),
        np.full((camera.height, camera.width, 3), 255, dtype=np.uint8),
    ):
        detection = TofuPoseEstimator(camera, RIGID).estimate(image)
        assert detection.pose is None
        assert "nothing as bright" in detection.reason


def test_a_moved_camera_is_noticed(camera: Camera) -> None:
    """Where the camera was, the block would hover."""
    image = synthetic.tofu_image(camera, [0.45, 0.0, 0.02, 0.3], blur=0.7, noise=3.0)
    moved = camera.moved(camera.position + np.array([0.0, 0.0, 0.06]), camera.quaternion)
    assert TofuPoseEstimator(moved, RIGID).estimate(image).pose is None


def test_another_picture_size_is_refused(camera: Camera) -> None:
    with pytest.raises(ValueError, match=r"480, 640"):
        TofuPoseEstimator(camera).estimate(np.zeros((480, 640, 3), dtype=np.uint8))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": (0.05, 0.03, 0.0)}, "size"),
        ({"sag": 0.02}, "sag"),
        ({"region": (1.0, 0.0, 0.0, 1.0)}, "region"),
        ({"min_score": 0.0}, "min_score"),
        ({"reduction": 3}, "reduction"),
        ({"spacing": float("nan")}, "spacing"),
    ],
)
def test_bad_settings_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EstimatorConfig(**change)


def test_settled_size_of_silk_tofu() -> None:
    """rho g h^2 / (2 E) = 0.89 mm at 9 kPa."""
    sag = 1020.0 * 9.81 * 0.04**2 / (2.0 * 9000.0)
    assert EstimatorConfig().sag == pytest.approx(sag, abs=2e-5)
    length, width, height = EstimatorConfig().settled_size
    assert height == pytest.approx(0.0391)
    assert length / 0.05 == pytest.approx(width / 0.03) == pytest.approx(1.007, abs=1e-4)
