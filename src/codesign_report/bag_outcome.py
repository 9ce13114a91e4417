"""Grasp metrics of any recorded trial, with stress where there was a simulator. Needs no ROS."""

from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from codesign_policy.metrics import GraspMetrics, pose_metrics
from codesign_report.bag import read_trial, trial_metrics
from codesign_report.bag_messages import (
    BagError,
    Messages,
    policy_window,
    read_messages,
    recorded_topics,
    stamp,
)

POSES = ("/object_pose", "/tcp_pose", "/gripper_state")


@dataclass(frozen=True)
class Outcome:
    """Of one trial.

    Attributes:
        gripper, seed: its label; seed -1: not recorded.
        stress_known: the trial was simulated. If not, success comes from pose and gripper, and
            stress, forces and score are NaN.
        metrics: of the grasp.
        weight: of the object [N]; NaN if not known.
    """

    gripper: str
    seed: int
    stress_known: bool
    metrics: GraspMetrics
    weight: float


def read_outcome(bag: str | Path) -> Outcome:
    """Judges one trial.

    Raises:
        BagError: not a bag, truncated, a topic is missing or empty, or a value makes no sense.
        ValueError: as `grasp_metrics`.
    """
    path = Path(bag)
    if "/stress" in recorded_topics(path):
        trial = read_trial(path)
        return Outcome(trial.gripper, trial.seed, True, trial_metrics(trial), trial.weight)
    messages = read_messages(path, POSES, ("/trial_state", "/finger_design"))
    try:
        gripper, seed = _label(path, messages)
        return Outcome(gripper, seed, False, _metrics(path, messages), nan)
    except AttributeError as error:
        raise BagError(
            f"{path}: recorded with other message definitions ({error}): record again"
        ) from error


def _metrics(path: Path, messages: Messages) -> GraspMetrics:
    start, end = policy_window(messages)
    heard = {topic: {stamp(m): m for m in messages[topic]} for topic in POSES}
    try:
        return pose_metrics(
            start,
            end,
            {time: _xyz(m.pose.position) for time, m in heard["/object_pose"].items()},
            {time: _xyz(m.pose.position) for time, m in heard["/tcp_pose"].items()},
            {time: float(m.width) for time, m in heard["/gripper_state"].items()},
        )
    except ValueError as error:
        raise BagError(f"{path}: {error}: record the whole trial") from error


def _label(path: Path, messages: Messages) -> tuple[str, int]:
    """Gripper and seed; from the file's name without trial states."""
    states = [m for m in messages["/trial_state"] if m.gripper]
    if states:
        return states[-1].gripper, int(states[-1].seed)
    gripper, _, seed = path.stem.rpartition("-seed")
    if gripper and seed.isdigit():
        return gripper, int(seed)
    fingers = messages["/finger_design"]
    return (fingers[-1].name if fingers else "") or path.stem, -1


def _xyz(message: Any) -> np.ndarray:
    return np.array([message.x, message.y, message.z])
