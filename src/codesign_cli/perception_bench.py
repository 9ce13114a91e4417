"""How exact and how fast the block's pose is found in rendered pictures, whose truth is known."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from codesign_perception import Camera, TofuPose, TofuPoseEstimator
from codesign_perception.board import CharucoBoard, View
from codesign_perception.calibration import (
    Calibration,
    calibrate_extrinsics,
    calibrate_intrinsics,
    flat_pose,
)
from codesign_perception.edges import Image
from codesign_perception.frames import decode, encode
from codesign_perception.tofu_pose import wrapped
from codesign_report.recording import SoftBody
from codesign_report.rendered_camera import Effects, RenderedCamera, SceneState, board_prop
from codesign_sim import Block, Simulator

CENTER = np.array([0.45, 0.0])  # m: where blocks lie around
SPREAD = 0.05  # m, each way
EFFECTS = Effects(noise=4.0, defocus=0.8, motion=1.0, light=0.2, clutter=8)
BOARD_EFFECTS = Effects(noise=3.0, defocus=0.7, light=0.1)
LENS_VIEWS = 16
BOARD_PLACES = ((0.45, 0.0, 0.0), (0.42, 0.05, 0.6), (0.48, -0.05, -0.5))  # x, y [m], yaw [rad]
FAR = np.array([4.0, 0.0, -2.0])  # m: out of sight


@dataclass(frozen=True)
class _Truth:
    positions: np.ndarray
    center: np.ndarray
    yaw: float


def default_camera() -> Camera:
    """Half a metre before the block, as in the simulated graph."""
    return Camera.looking_at(
        [0.78, 0.06, 0.30], [0.45, 0.0, 0.03], focal=1000.0,
        distortion=[-0.05, 0.02, 0.0005, -0.0005, 0.0],
    )  # fmt: skip


def run_bench(
    images: int,
    empty: int,
    seed: int,
    camera: Camera | None = None,
    on_progress: Callable[[str], None] = lambda _: None,
) -> dict[str, float]:
    """Renders, calibrates, estimates.

    Args:
        images: with the block at rest, at random places and yaws.
        empty: without it, clutter only.
        seed: of everything.
        camera: the true one.

    Returns:
        Position errors are distances of the told centre from the centre of mass [m].
    """
    cv2.setNumThreads(1)
    camera = camera or default_camera()
    on_progress("calibrating from rendered boards")
    calibrated, lens_error = _calibrated(camera, seed)
    result = {
        "lens_reprojection_px": lens_error,
        "place_reprojection_px": calibrated.error,
        "camera_off_m": float(np.linalg.norm(calibrated.camera.position - camera.position)),
    }
    body, rest, mass_center = _settled_block()
    effects = Effects(**{**vars(EFFECTS), "seed": seed})
    estimators = {
        "true": TofuPoseEstimator(camera),
        "calibrated": TofuPoseEstimator(calibrated.camera),
    }
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in estimators}
    seconds: list[float] = []
    decoding: list[float] = []
    false = 0
    random = np.random.default_rng(seed)
    with RenderedCamera(camera, body, effects=effects) as rendered:
        for i in range(images + empty):
            if i % 20 == 0:
                on_progress(f"picture {i} of {images + empty}")
            truth = _placed(random, rest, mass_center)
            x, y = truth.center[:2]
            rendered.scatter_clutter(seed + i, (float(x), float(y)))
            shape = truth.positions if i < images else truth.positions + FAR
            picture = rendered.capture(SceneState(shape), i)[..., ::-1]
            started = time.process_time()
            image = decode(encode(np.ascontiguousarray(picture)))
            decoding.append(time.process_time() - started)
            assert image is not None
            for name, estimator in estimators.items():
                pose, spent = _timed(estimator, image)
                if i >= images:
                    false += pose is not None
                    continue
                seconds.append(spent)
                if pose is not None:
                    errors[name].append(_error(pose, truth))
    for name, values in errors.items():
        result |= _summary(name, values, images)
    result["false_positives"] = false
    result["empty_pictures"] = 2 * empty
    result["images_per_cpu_second"] = 1.0 / float(np.mean(seconds))
    result["p95_ms"] = 1e3 * float(np.percentile(seconds, 95))
    result["jpeg_there_and_back_ms"] = 1e3 * float(np.mean(decoding))
    return result


def _timed(estimator: TofuPoseEstimator, image: Image) -> tuple[TofuPose | None, float]:
    """A pose from this picture alone, and the CPU time that it took [s]."""
    estimator.reset()
    started = time.process_time()
    pose = estimator.estimate(image).pose
    return pose, time.process_time() - started


def _error(pose: TofuPose, truth: _Truth) -> tuple[float, float]:
    return (
        float(np.linalg.norm(pose.position - truth.center)),
        abs(wrapped(pose.yaw - truth.yaw)),
    )


def _summary(name: str, errors: list[tuple[float, float]], images: int) -> dict[str, float]:
    found = np.array(errors).reshape(-1, 2)
    summary = {f"{name}_detected": len(found) / images}
    for k, (kind, unit) in enumerate((("position", "m"), ("yaw", "rad"))):
        for part in (50, 95):
            value = float(np.percentile(found[:, k], part)) if len(found) else float("nan")
            summary[f"{name}_{kind}_p{part}_{unit}"] = value
    return summary


def _settled_block() -> tuple[SoftBody, np.ndarray, np.ndarray]:
    """The block at rest on the table: topology, nodes (N, 3) and centre of mass (3,) [m]."""
    simulator = Simulator(Block.tofu(600))
    simulator.reset()
    body = SoftBody(
        simulator.rest_positions,
        simulator.tetrahedra,
        simulator.surface_triangles,
        simulator.surface_tetrahedra,
    )
    center = simulator.object_pose()[0][0]
    return body, np.array(simulator.positions[0], dtype=np.float64), center


def _placed(random: np.random.Generator, rest: np.ndarray, center: np.ndarray) -> _Truth:
    yaw = float(random.uniform(-np.pi / 2.0, np.pi / 2.0))
    place = np.array([*CENTER + random.uniform(-SPREAD, SPREAD, 2), center[2]])
    turned = Rotation.from_euler("z", yaw).apply(rest - center)
    return _Truth(turned + place, place, yaw)


def _calibrated(camera: Camera, seed: int) -> tuple[Calibration, float]:
    """Lens and place as the calibration commands find them from rendered boards."""
    board = CharucoBoard()
    prop = board_prop(board.picture(80), board.size)
    effects = Effects(**{**vars(BOARD_EFFECTS), "seed": seed})
    random = np.random.default_rng(seed)

    def seen(pose: np.ndarray, number: int) -> View | None:
        prop.position = pose[:3, 3]
        prop.rotation = pose[:3, :3]
        picture = rendered.capture(SceneState(), number)[..., ::-1]
        return board.find(np.ascontiguousarray(picture))

    with RenderedCamera(camera, effects=effects, props=[prop]) as rendered:
        views = [seen(_before(camera, random), i) for i in range(LENS_VIEWS)]
        lens = calibrate_intrinsics(
            [view for view in views if view is not None], camera.width, camera.height
        )
        flat = [flat_pose((x, y, 0.0015), yaw) for x, y, yaw in BOARD_PLACES]
        found = [(seen(pose, 100 + i), pose) for i, pose in enumerate(flat)]
    place = calibrate_extrinsics(
        [view for view, _ in found if view is not None],
        [pose for view, pose in found if view is not None],
        lens.camera,
    )
    return place, lens.error


def _before(camera: Camera, random: np.random.Generator) -> np.ndarray:
    """A tilted board somewhere in view, (4, 4)."""
    pixel = random.uniform([0.3, 0.3], [0.7, 0.7]) * [camera.width, camera.height]
    origin, direction = camera.rays([pixel])
    pose = np.eye(4)
    pose[:3, 3] = origin + direction[0] * random.uniform(0.32, 0.5)
    # Facing the camera, then turned and tilted: x to the right, y up, z towards the camera.
    facing = camera.rotation * [1.0, -1.0, -1.0]
    tilt = Rotation.from_euler("zyx", random.uniform([-0.5, -0.6, -0.6], [0.5, 0.6, 0.6]))
    pose[:3, :3] = facing @ tilt.as_matrix()
    pose[2, 3] = max(pose[2, 3], 0.10)
    return pose
