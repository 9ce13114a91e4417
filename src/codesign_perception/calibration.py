"""Intrinsics, place of the camera, and hand-eye calibration from pictures of a ChArUco board.

Each result is refused when its reprojection error or its uncertainty says that it is no good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from codesign_perception.board import View
from codesign_perception.camera import Camera, Floats

MAX_ERROR = 0.7  # px, root mean square
MAX_FOCAL_SIGMA = 0.005  # of the focal length
FEWEST_LENS_VIEWS = 8
LEAST_TILT = 15.0  # degrees between the board and the image plane
FEWEST_TILTED = 3
FEWEST_HAND_VIEWS = 6
FEWEST_TURN = np.radians(20.0)  # between the most different postures of a hand-eye calibration


class CalibrationError(ValueError):
    """The pictures do not give a camera that can be trusted; the message says what to do."""


@dataclass(frozen=True)
class Calibration:
    """A camera, its reprojection error (root mean square) [px], and how many views were used."""

    camera: Camera
    error: float
    views: int


def calibrate_intrinsics(
    views: Sequence[View], width: int, height: int, max_error: float = MAX_ERROR
) -> Calibration:
    """Lens and focal length from views of the board at many distances and tilts.

    Raises:
        CalibrationError: too few views, too alike, or they do not fit together.
    """
    if len(views) < FEWEST_LENS_VIEWS:
        raise CalibrationError(
            f"board found in {len(views)} pictures, at least {FEWEST_LENS_VIEWS} are needed: take "
            "more, near and far, tilted, and in all corners of the picture"
        )
    points = [v.points.astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32) for v in views]
    error, matrix, distortion, turns, _, sigmas, _, per_view = cv2.calibrateCameraExtended(
        points, pixels, (width, height), np.eye(3), np.zeros(5)
    )
    worst = int(np.argmax(per_view))
    _check_error(error, max_error, f"picture {worst + 1} is worst: leave it out, or")
    _check_tilts(turns)
    relative = float(sigmas.ravel()[0] / matrix[0, 0])
    if relative > MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"focal length is uncertain by {relative:.2%}, at most {MAX_FOCAL_SIGMA:.2%}: the "
            "views are too alike, tilt the board by 30 degrees and more"
        )
    lens = np.asarray(distortion, dtype=np.float64).ravel()[:5]
    return Calibration(
        Camera(width, height, np.asarray(matrix, dtype=np.float64), lens), float(error), len(views)
    )


def calibrate_extrinsics(
    views: Sequence[View],
    board_poses: Sequence[Floats],
    lens: Camera,
    max_error: float = MAX_ERROR,
) -> Calibration:
    """The camera's place from views of a board whose (4, 4) poses in link_base are known.

    Raises:
        CalibrationError: no view, or they do not fit the lens and the poses.
    """
    if not views:
        raise CalibrationError(
            "the board was found in no picture: light it evenly, keep all of it in view, and "
            "check columns, rows and sizes"
        )
    world = np.concatenate(
        [v.points @ t[:3, :3].T + t[:3, 3] for v, t in zip(views, board_poses, strict=True)]
    )
    pixels = np.concatenate([v.pixels for v in views])
    # About their middle, where OpenCV's solvers are best conditioned.
    middle = world.mean(axis=0)
    found, turn, shift = cv2.solvePnP(
        world - middle, pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found:
        raise CalibrationError("no place of the camera explains the pictures: check the lens")
    turn, shift = cv2.solvePnPRefineLM(
        world - middle, pixels, lens.matrix, lens.distortion, turn, shift
    )
    rotation = Rotation.from_rotvec(turn.ravel()).inv()
    camera = lens.moved(middle - rotation.apply(shift.ravel()), rotation.as_quat())
    error = reprojection_error(camera, world, pixels)
    _check_error(error, max_error, "is the board where it was said to be, and the lens this one?")
    return Calibration(camera, error, len(views))


def calibrate_hand_eye(
    views: Sequence[View],
    flange_poses: Sequence[Floats],
    lens: Camera,
    max_error: float = MAX_ERROR,
) -> tuple[Calibration, Floats]:
    """The camera's place, and the board's on the flange, from views with known flange poses.

    Args:
        views: one per posture of the arm, the board fixed to the flange.
        flange_poses: (4, 4) of the flange in link_base, one per view.
        lens: intrinsics; its place is not used.
        max_error: reprojection error above which the result is refused [px].

    Returns:
        The calibration and the (4, 4) pose of the board in the flange's frame.

    Raises:
        CalibrationError: too few postures, too alike, or they do not fit together.
    """
    if len(views) < FEWEST_HAND_VIEWS:
        raise CalibrationError(
            f"board found in {len(views)} pictures, at least {FEWEST_HAND_VIEWS} are needed: move "
            "the arm to more postures"
        )
    _check_turns(flange_poses)
    boards = [_board_in_camera(view, lens) for view in views]
    inverse = [np.linalg.inv(pose) for pose in flange_poses]
    # Eye beside the arm: with the flange's poses inverted, the "hand" is link_base.
    rotation, position = cv2.calibrateHandEye(
        [t[:3, :3] for t in inverse],
        [t[:3, 3] for t in inverse],
        [t[:3, :3] for t in boards],
        [t[:3, 3] for t in boards],
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    camera_pose = _matrix(rotation, position.ravel())
    mount = inverse[0] @ camera_pose @ boards[0]
    camera_pose, mount, error = _refined(camera_pose, mount, views, flange_poses, lens)
    _check_error(error, max_error, "did the board move on the flange, or a joint angle not fit?")
    quaternion = Rotation.from_matrix(camera_pose[:3, :3]).as_quat()
    return Calibration(lens.moved(camera_pose[:3, 3], quaternion), error, len(views)), mount


def reprojection_error(camera: Camera, world: Floats, pixels: Floats) -> float:
    """Root mean square distance of (N, 3) points' projections from (N, 2) pixels."""
    difference = camera.project(world) - pixels
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def _refined(
    camera_pose: Floats,
    mount: Floats,
    views: Sequence[View],
    flange_poses: Sequence[Floats],
    lens: Camera,
) -> tuple[Floats, Floats, float]:
    """Both poses such that all corners appear where they were seen."""

    def residuals(values: Floats) -> Floats:
        camera, board = _from_vector(values[:6]), _from_vector(values[6:])
        moved = lens.moved(camera[:3, 3], Rotation.from_matrix(camera[:3, :3]).as_quat())
        parts = []
        for view, flange in zip(views, flange_poses, strict=True):
            t = flange @ board
            world = view.points @ t[:3, :3].T + t[:3, 3]
            parts.append(np.nan_to_num(moved.project(world) - view.pixels, nan=1e3).ravel())
        return np.concatenate(parts)

    start = np.concatenate([_to_vector(camera_pose), _to_vector(mount)])
    solution = least_squares(residuals, start, x_scale="jac", method="lm")
    error = float(np.sqrt(2.0 * (solution.fun**2).mean()))
    return _from_vector(solution.x[:6]), _from_vector(solution.x[6:]), error


def _board_in_camera(view: View, lens: Camera) -> Floats:
    _, turn, shift = cv2.solvePnP(
        view.points, view.pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    turn, shift = cv2.solvePnPRefineLM(
        view.points, view.pixels, lens.matrix, lens.distortion, turn, shift
    )
    return _matrix(Rotation.from_rotvec(turn.ravel()).as_matrix(), shift.ravel())


def _check_tilts(turns: Sequence[npt.ArrayLike]) -> None:
    """Views that all face the board leave focal length and distance undecided."""
    axes = [Rotation.from_rotvec(np.ravel(turn)).as_matrix()[:, 2] for turn in turns]
    tilts = np.degrees(np.arccos(np.clip([abs(axis[2]) for axis in axes], 0.0, 1.0)))
    tilted = int((tilts >= LEAST_TILT).sum())
    if tilted < FEWEST_TILTED:
        raise CalibrationError(
            f"in {tilted} pictures the board is tilted by {LEAST_TILT:.0f} degrees or more, at "
            f"least {FEWEST_TILTED} are needed: tilt it about both axes"
        )


def _check_turns(flange_poses: Sequence[Floats]) -> None:
    """Hand-eye needs turns about two axes at least."""
    first = Rotation.from_matrix(flange_poses[0][:3, :3])
    turns = np.array(
        [(first.inv() * Rotation.from_matrix(t[:3, :3])).as_rotvec() for t in flange_poses[1:]]
    )
    spread = np.linalg.svd(turns, compute_uv=False) / np.sqrt(len(turns))
    second = float(spread[1])
    if second < FEWEST_TURN / 2.0:
        raise CalibrationError(
            f"the flange turns about a second axis by {np.degrees(second):.1f} degrees (rms), at "
            f"least {np.degrees(FEWEST_TURN / 2.0):.0f} are needed: tilt it both ways"
        )


def _check_error(error: float, limit: float, remedy: str) -> None:
    if not error <= limit:
        raise CalibrationError(
            f"reprojection error is {error:.2f} px, at most {limit:.2f}: {remedy} take new pictures"
        )


def _matrix(rotation: npt.ArrayLike, position: npt.ArrayLike) -> Floats:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def _to_vector(matrix: Floats) -> Floats:
    turn = Rotation.from_matrix(matrix[:3, :3]).as_rotvec()
    return np.concatenate([turn, matrix[:3, 3]])


def _from_vector(vector: Floats) -> Floats:
    return _matrix(Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:])


def flat_pose(position: Sequence[float], yaw: float) -> Floats:
    """(4, 4) of a board that lies flat, its middle at `position` [m], x turned by `yaw` [rad]."""
    return _matrix(Rotation.from_euler("z", yaw).as_matrix(), np.asarray(position, dtype=float))
