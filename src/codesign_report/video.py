"""A trial as an H.264 video that plays in browsers."""

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from codesign_policy.files import replacing
from codesign_policy.metrics import in_contact, lift
from codesign_report.overlay import Overlay, nice_ceiling
from codesign_report.recording import Floats, TrialRecording
from codesign_report.scene import Camera, Image, SceneRenderer

FPS = 20
"""As often as the simulation is recorded."""

LONGEST = 600.0
"""Longer than this a trial can't be [s]: a wrong stamp would fill the disk with video."""

VIEW_HEIGHT = 0.168
"""Of the picture, at the object [m]."""

DISTANCE = 0.60
"""From the camera to the object [m]."""

ELEVATION = np.radians(18.0)
AZIMUTH = np.radians(28.0)
"""Of the camera, off the direction in which both fingers' contacts are seen edge-on."""

FOLLOW = 0.55
"""Share of the lift that the camera follows: the rest shows the object rising."""


def stress_ceiling(trials: Sequence[TrialRecording]) -> float:
    """Upper end of a colour scale that serves all trials [Pa]: their highest top-10 % stress."""
    return nice_ceiling(max(float(trial.stress.top10.max()) for trial in trials))


def write_video(
    trial: TrialRecording,
    path: str | Path,
    *,
    stress_max: float | None = None,
    width: int = 1280,
    height: int = 720,
    fps: int = FPS,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a trial in real time. Video time 0 is the first sample of `trial.motion`.

    Args:
        path: of the .mp4, written atomically.
        stress_max: von Mises stress at the top of the colour scale [Pa]; None: `stress_ceiling`.
        width, height: even [px].
        fps: pictures per second, 1 to 120.
        progress: called with pictures done and in total.

    Raises:
        ValueError: size, rate or duration make no sense.
        RuntimeError: no offscreen OpenGL.
    """
    if width % 2 or height % 2:
        raise ValueError(f"video is {width} x {height} px: H.264 needs even numbers")
    if not 1 <= fps <= 120:
        raise ValueError(f"fps is {fps}: give 1 to 120")
    frames = frame_times(trial, fps)
    maximum = stress_ceiling([trial]) if stress_max is None else stress_max
    target = Path(path)
    with replacing(target) as temporary, Encoder(temporary, width, height, fps) as encoder:
        for i, picture in enumerate(_pictures(trial, frames, width, height, maximum)):
            encoder.add(picture)
            if progress:
                progress(i + 1, len(frames))
    return target


class Encoder:
    """Pictures in, H.264 in MP4 out: 4:2:0, BT.709, index in front."""

    def __init__(self, path: Path, width: int, height: int, fps: int) -> None:
        import av

        self._container: Any = av.open(
            str(path), "w", format="mp4", options={"movflags": "+faststart"}
        )
        self._stream: Any = self._container.add_stream("libx264", rate=Fraction(fps))
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "21", "preset": "veryfast"}
        # Browsers take high-definition video for BT.709: say so and convert accordingly.
        context = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = 1
        context.color_range = 1

    def __enter__(self) -> "Encoder":
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            self._container.mux(self._stream.encode())
        self._container.close()

    def add(self, picture: Image) -> None:
        """Append a picture (height, width, 3)."""
        import av

        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        self._container.mux(self._stream.encode(frame))


def frame_count(trial: TrialRecording, fps: int = FPS) -> int:
    """How many pictures `write_video` renders."""
    return len(frame_times(trial, fps))


def frame_times(trial: TrialRecording, fps: int = FPS) -> Floats:
    """When the pictures are taken [s].

    Raises:
        ValueError: the trial is too long.
    """
    first, last = trial.motion.times[[0, -1]]
    if last - first > LONGEST:
        raise ValueError(
            f"{trial.bag}: lasts {last - first:.0f} s, more than {LONGEST:.0f} s: check its stamps"
        )
    return np.arange(first, last + 1e-9, 1.0 / fps)


def _pictures(
    trial: TrialRecording, frames: Floats, width: int, height: int, stress_max: float
) -> Iterator[Image]:
    first = trial.motion.positions[0]
    table = float(first[:, 2].min())
    center = first.mean(axis=0)
    seed = f" · seed {trial.seed}" if trial.seed >= 0 else ""
    overlay = Overlay(width, height, stress_max, trial.gripper + seed)
    cameras = _cameras(trial, frames)
    rise = lift(trial.object_height, in_contact(trial.stress.left_force, trial.stress.right_force))
    with SceneRenderer(
        trial.soft_body,
        (trial.left_finger, trial.right_finger),
        width,
        height,
        stress_range=(0.0, stress_max),
        table_height=table,
        center=(float(center[0]), float(center[1])),
    ) as renderer:
        for t, renderer.camera in zip(frames, cameras, strict=True):
            picture = renderer.render(*_state(trial, t))
            top10 = np.interp(t, trial.stress.times, trial.stress.top10)
            yield overlay.draw(
                picture,
                [
                    ("Time", f"{t - frames[0]:.1f} s"),
                    ("Top-10 % stress", f"{top10:,.0f} Pa".replace(",", " ")),
                    ("Lift", f"{_millimetres(np.interp(t, trial.stress.times, rise))} mm"),
                ],
            )


def _millimetres(metres: float) -> int:
    """Whole ones: an integer has no negative zero."""
    return round(1e3 * float(metres))


def _state(trial: TrialRecording, t: float) -> tuple[Any, Any, Floats, Floats]:
    """Shape, stress and finger poses at a time between the samples."""
    motion, stress = trial.motion, trial.stress
    return (
        _between(motion.times, motion.positions, t),
        _between(stress.times, stress.von_mises, t),
        _between(motion.times, motion.left_pose, t),
        _between(motion.times, motion.right_pose, t),
    )


def _between(times: Floats, values: Any, t: float) -> Any:
    """Linear interpolation along the first axis, held at both ends."""
    after = int(np.clip(np.searchsorted(times, t), 1, len(times) - 1))
    share = np.clip((t - times[after - 1]) / (times[after] - times[after - 1]), 0.0, 1.0)
    return (1.0 - share) * values[after - 1] + share * values[after]


def _cameras(trial: TrialRecording, frames: Floats) -> list[Camera]:
    """From the side where both contacts show, following the object's lift smoothly."""
    centers = trial.motion.positions.mean(axis=1, dtype=np.float64)
    middle = int(np.argmax(np.interp(trial.motion.times, trial.stress.times, trial.stress.top10)))
    across = trial.motion.left_pose[middle, :2] - trial.motion.right_pose[middle, :2]
    # At a right angle to the opening direction, on the side of the robot's front.
    side = np.arctan2(across[1], across[0]) + np.pi / 2.0
    side = (side + np.pi / 2.0) % np.pi - np.pi / 2.0
    azimuth = side - AZIMUTH
    away = np.array(
        [
            np.cos(azimuth) * np.cos(ELEVATION),
            np.sin(azimuth) * np.cos(ELEVATION),
            np.sin(ELEVATION),
        ]
    )
    fovy = 2.0 * np.arctan(VIEW_HEIGHT / 2.0 / DISTANCE)
    start = centers[0] + [0.0, 0.0, 0.018]
    cameras = []
    for t in frames:
        target = start + FOLLOW * (_smoothed(trial.motion.times, centers, t) - centers[0])
        cameras.append(Camera.look_at(target + DISTANCE * away, target, fovy=fovy))
    return cameras


def _smoothed(times: Floats, values: Floats, t: float, width: float = 0.3) -> Floats:
    """Gaussian average around a time; the recording is complete, so it may look ahead."""
    weights = np.exp(-0.5 * ((times - t) / width) ** 2) * np.gradient(times)
    average: Floats = weights @ values / weights.sum()
    return average
