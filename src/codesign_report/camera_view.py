"""The pictures of a trial's camera as a video beside the rendered one."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from codesign_policy.files import replacing
from codesign_report.bag_messages import read_messages, recorded_topics, stamp
from codesign_report.recording import TrialRecording
from codesign_report.scene import Image
from codesign_report.video import FPS, Encoder, frame_times

VIEWS = ("/tofu_pose_estimator/debug/compressed", "/camera/image/compressed")
"""Compressed pictures, the best first: with the estimate drawn in, and as they were taken."""

SIZE = (640, 360)


def camera_topic(bag: str | Path) -> str | None:
    """The topic of a bag's camera pictures, None without any.

    Raises:
        BagError: not a bag, or truncated.
    """
    recorded = recorded_topics(Path(bag))
    return next((topic for topic in VIEWS if topic in recorded), None)


def write_camera_video(
    trial: TrialRecording, path: str | Path, topic: str, size: tuple[int, int] = SIZE
) -> Path:
    """What the camera saw, in real time; as long as `video.write_video` makes it.

    Args:
        path: of the .mp4, written atomically.
        topic: of sensor_msgs/CompressedImage.
        size: width and height, even [px].

    Raises:
        BagError: the bag cannot be read.
        ValueError: a picture that cannot be decoded.
    """
    times = frame_times(trial, FPS)
    with replacing(Path(path)) as temporary, Encoder(temporary, *size, FPS) as encoder:
        for picture in _pictures(trial, times, topic, size):
            encoder.add(picture)
    return Path(path)


def _pictures(
    trial: TrialRecording, times: np.ndarray, topic: str, size: tuple[int, int]
) -> Iterator[Image]:
    """For each time the newest picture until then; black before the first."""
    shown = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    taken = [
        ((stamp(m) - trial.start) * 1e-9, m.data) for m in read_messages(trial.bag, (topic,))[topic]
    ]
    taken.sort(key=lambda picture: picture[0])
    following = 0
    for t in times:
        newest = None
        while following < len(taken) and taken[following][0] <= t + 1e-6:
            newest = taken[following][1]
            following += 1
        if newest is not None:
            shown = _decoded(newest, size)
        yield shown


def _decoded(data: np.ndarray, size: tuple[int, int]) -> Image:
    picture = cv2.imdecode(np.asarray(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError("a camera picture cannot be decoded: record JPEG or PNG")
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2RGB), dtype=np.uint8)
