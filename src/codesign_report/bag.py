"""Reading a trial bag: a rosbag2 folder (MCAP) into a TrialRecording. Needs no ROS.

Message definitions are taken from the bag itself, times from each message's header.stamp.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from codesign_policy.metrics import GraspMetrics, grasp_metrics
from codesign_report.bag_messages import (
    BagError,
    Messages,
    nanoseconds,
    policy_window,
    read_messages,
    stamp,
)
from codesign_report.recording import (
    Floats,
    MotionSeries,
    PoseEstimates,
    SoftBody,
    StressSeries,
    TrialDomain,
    TrialRecording,
    TriangleMesh,
)

REQUIRED = ("/stress", "/simulation_state", "/soft_body_mesh", "/finger_design", "/object_pose")
TRUTH, REJECTED = "/ground_truth/object_pose", "/object_pose/rejected"
"""Beside a camera: the object's true pose, and the pictures in which it was not found."""
OPTIONAL = ("/gripper_state", "/trial_state", TRUTH, REJECTED)


def read_trial(bag: str | Path) -> TrialRecording:
    """Read one trial.

    If the bag holds /trial_state, only the time from the policy's start to the verdict counts.

    Args:
        bag: rosbag2 folder, or an .mcap file (what a killed recorder leaves).

    Raises:
        BagError: not a bag, truncated, a topic is missing or empty, or a value makes no sense.
    """
    path = Path(bag)
    messages = read_messages(path, REQUIRED, OPTIONAL)
    try:
        return _recording(path, messages)
    except AttributeError as error:
        raise BagError(
            f"{path}: recorded with other message definitions ({error}): record again"
        ) from error


def _recording(path: Path, messages: Messages) -> TrialRecording:
    start, stop = policy_window(messages)
    if not start <= stop:
        raise BagError(
            f"{path}: the policy starts {(start - stop) * 1e-9:.3f} s after the recording's end: "
            "record the whole trial"
        )
    gripper, seed, domain = _label(path, messages)
    # Where a camera observes the block, the simulator tells the truth beside it.
    place = TRUTH if messages[TRUTH] else "/object_pose"
    times, positions = _series(path, messages, place, start, stop, _position)
    gripper_times, width = np.zeros(0), np.zeros((0, 1))
    if messages["/gripper_state"]:
        gripper_times, width = _series(
            path, messages, "/gripper_state", start, stop, lambda m: [m.width]
        )
    body = _soft_body(path, messages["/soft_body_mesh"][-1])
    design = messages["/finger_design"][-1]
    return TrialRecording(
        bag=path,
        gripper=gripper,
        seed=seed,
        domain=domain,
        soft_body=body,
        left_finger=_mesh(path, "left finger", design.left),
        right_finger=_mesh(path, "right finger", design.right),
        stress=_stress(path, messages, start, stop, len(body.tetrahedra)),
        motion=_motion(path, messages, start, stop, len(body.rest_positions)),
        object_times=times,
        object_positions=positions,
        gripper_times=gripper_times,
        gripper_width=width[:, 0],
        estimates=_estimates(path, messages, start, stop) if messages[TRUTH] else None,
        start=start,
    )


def _estimates(path: Path, messages: Messages, start: int, stop: int) -> PoseEstimates:
    """Of the camera, at the times at which the truth is known as well."""
    times, seen = _series(path, messages, "/object_pose", start, stop, _position)
    true_times, true = _series(path, messages, TRUTH, start, stop, _position)
    there = np.column_stack([np.interp(times, true_times, axis) for axis in true.T])
    rejected = np.unique([nanoseconds(m.stamp) for m in messages[REJECTED]])
    rejected = rejected[(rejected > start) & (rejected <= stop)]
    return PoseEstimates(times, seen - there, (rejected - start) * 1e-9)


def trial_metrics(trial: TrialRecording | str | Path, **limits: float) -> GraspMetrics:
    """Grasp metrics of a recording or a bag; `limits` as in `grasp_metrics`.

    Raises:
        BagError: as `read_trial`.
        ValueError: as `grasp_metrics`.
    """
    recording = trial if isinstance(trial, TrialRecording) else read_trial(trial)
    stress = recording.stress
    return grasp_metrics(
        stress.times,
        stress.top10,
        stress.median,
        stress.left_force,
        stress.right_force,
        recording.object_height,
        **limits,
    )


def _series(
    path: Path,
    messages: Messages,
    topic: str,
    start: int,
    stop: int,
    values: Callable[[Any], Any],
) -> tuple[Floats, np.ndarray]:
    """Times since start and values of the messages within the window, sorted, no stamp twice."""
    stamps = np.array([stamp(m) for m in messages[topic]])
    stamps, order = np.unique(stamps, return_index=True)
    # Not the sample at the start itself: published before, it may be missing in the recording.
    inside = (stamps > start) & (stamps <= stop)
    if inside.sum() < 2:
        raise BagError(
            f"{path}: {topic} has {inside.sum()} samples while the policy ran "
            f"({(stop - start) * 1e-9:.1f} s), at least 2 are needed: record the whole trial"
        )
    rows = [values(messages[topic][i]) for i in order[inside]]
    try:
        array = np.asarray(rows, dtype=np.float64)
    except ValueError as error:
        raise BagError(f"{path}: {topic} changes its length: reset and record again") from error
    if not np.isfinite(array).all():
        raise BagError(f"{path}: {topic} holds a value that is not finite: check the simulator")
    return (stamps[inside] - start) * 1e-9, array


def _stress(path: Path, messages: Messages, start: int, stop: int, tetrahedra: int) -> StressSeries:
    def values(m: Any) -> list[float]:
        forces = [[f.x, f.y, f.z] for f in (m.left_force, m.right_force)]
        return [m.top10_mean, m.median, *forces[0], *forces[1], *m.von_mises]

    times, rows = _series(path, messages, "/stress", start, stop, values)
    _require_length(path, "/stress", rows.shape[1] - 8, tetrahedra, "tetrahedra")
    return StressSeries(
        times=times,
        top10=rows[:, 0],
        median=rows[:, 1],
        left_force=rows[:, 2:5],
        right_force=rows[:, 5:8],
        von_mises=rows[:, 8:].astype(np.float32),
    )


def _motion(path: Path, messages: Messages, start: int, stop: int, nodes: int) -> MotionSeries:
    def values(m: Any) -> list[float]:
        return [*_pose(m.left_finger), *_pose(m.right_finger), *m.positions]

    times, rows = _series(path, messages, "/simulation_state", start, stop, values)
    _require_length(path, "/simulation_state", rows.shape[1] - 14, 3 * nodes, "coordinates")
    return MotionSeries(
        times=times,
        positions=rows[:, 14:].reshape(len(rows), nodes, 3).astype(np.float32),
        left_pose=_same_sign(rows[:, :7]),
        right_pose=_same_sign(rows[:, 7:14]),
    )


def _same_sign(poses: np.ndarray) -> Floats:
    """Quaternions q and -q are one rotation; interpolation needs neighbours on one side."""
    turns = np.einsum("ti,ti->t", poses[1:, 3:], poses[:-1, 3:])
    signs = np.cumprod(np.concatenate([[1.0], np.where(turns < 0.0, -1.0, 1.0)]))
    return np.column_stack([poses[:, :3], poses[:, 3:] * signs[:, None]])


def _require_length(path: Path, topic: str, length: int, expected: int, what: str) -> None:
    if length != expected:
        raise BagError(
            f"{path}: {topic} has {length} {what}, /soft_body_mesh asks for {expected}: "
            "record one object per bag"
        )


def _pose(pose: Any) -> list[float]:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def _position(message: Any) -> list[float]:
    return _pose(message.pose)[:3]


def _label(path: Path, messages: Messages) -> tuple[str, int, TrialDomain]:
    """Gripper, seed and domain; from the file's name and the object without trial states."""
    mesh = messages["/soft_body_mesh"][-1]
    states = [m for m in messages["/trial_state"] if m.gripper]
    if states:
        state = states[-1]
        return state.gripper, int(state.seed), _domain(state.domain)
    gripper, _, seed = path.stem.rpartition("-seed")
    if gripper and seed.isdigit():
        return gripper, int(seed), _domain(mesh.domain)
    return messages["/finger_design"][-1].name or path.stem, -1, _domain(mesh.domain)


def _domain(message: Any) -> TrialDomain:
    return TrialDomain(
        **{name: float(getattr(message, name)) for name in TrialDomain.__dataclass_fields__}
    )


def _soft_body(path: Path, message: Any) -> SoftBody:
    body = SoftBody(
        rest_positions=np.asarray(message.rest_positions, dtype=np.float64).reshape(-1, 3),
        tetrahedra=np.asarray(message.tetrahedra, dtype=np.int64).reshape(-1, 4),
        surface_triangles=np.asarray(message.surface_triangles, dtype=np.int64).reshape(-1, 3),
        surface_tetrahedra=np.asarray(message.surface_tetrahedra, dtype=np.int64),
    )
    _require_indices(path, "tetrahedra", body.tetrahedra, len(body.rest_positions))
    _require_indices(path, "surface triangles", body.surface_triangles, len(body.rest_positions))
    _require_indices(path, "surface tetrahedra", body.surface_tetrahedra, len(body.tetrahedra))
    return body


def _mesh(path: Path, name: str, message: Any) -> TriangleMesh:
    vertices = np.array([[p.x, p.y, p.z] for p in message.vertices]).reshape(-1, 3)
    triangles = np.array([t.vertex_indices for t in message.triangles], dtype=np.int64)
    triangles = triangles.reshape(-1, 3)
    _require_indices(path, name, triangles, len(vertices))
    return TriangleMesh(vertices, triangles)


def _require_indices(path: Path, name: str, indices: np.ndarray, count: int) -> None:
    if not indices.size or indices.max() >= count:
        worst = indices.max() if indices.size else "none"
        raise BagError(
            f"{path}: {name} refer to index {worst} of {count}: publish a consistent mesh"
        )
