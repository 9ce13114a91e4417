"""From the bags of a run to videos, summary and report."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from codesign_report.bag import BagError, read_trial, trial_metrics
from codesign_report.camera_view import camera_topic, write_camera_video
from codesign_report.portrait import finger_portrait
from codesign_report.recording import TrialRecording
from codesign_report.report import SkippedBag, TrialResult, write_report, write_summary
from codesign_report.video import frame_count, stress_ceiling, write_video

Progress = Callable[[int, int, str], None]

ALONE, SIDE_BY_SIDE = (1280, 720), (960, 540)
"""Width and height of videos [px]: of one gripper, and of several, which share the page's width."""


@dataclass(frozen=True)
class RunReport:
    """What `build` wrote."""

    page: Path
    summary: Path
    trials: list[TrialResult]
    skipped: list[SkippedBag]


def build(
    run_dir: str | Path,
    trials: Sequence[str | Path] | None = None,
    progress: Progress | None = None,
    *,
    size: tuple[int, int] | None = None,
) -> RunReport:
    """Render a video per trial and write summary.json and report.html into the run's folder.

    All videos share one colour scale. Bags that can't be used are named in the report; the others
    still appear.

    Args:
        run_dir: folder to write to.
        trials: bags; None: every bag folder directly in `run_dir`.
        progress: called with pictures done, pictures in total and the trial's name.
        size: width and height of the videos, even [px]; None: `ALONE` or `SIDE_BY_SIDE`.

    Raises:
        BagError: no bag, or none that can be used.
        ValueError: two trials have the same name, or the size makes no sense.
        RuntimeError: no offscreen OpenGL.
        OSError: a file can't be written.
    """
    folder = Path(run_dir)
    bags = find_bags(folder) if trials is None else [Path(bag) for bag in trials]
    if not bags:
        raise BagError(f"{folder}: holds no trial bags: record a trial into it first")
    recordings, skipped = _read_all(bags)
    if not recordings:
        raise BagError(skipped[0].reason)
    _require_distinct(recordings)
    several = len({recording.gripper for recording in recordings}) > 1
    size = size or (SIDE_BY_SIDE if several else ALONE)
    results = _render_all(recordings, folder, size, progress)
    return RunReport(
        page=write_report(results, folder / "report.html", skipped, _portraits(recordings)),
        summary=write_summary(results, folder / "summary.json", skipped),
        trials=results,
        skipped=skipped,
    )


def find_bags(run_dir: Path) -> list[Path]:
    """Folders directly in a run that hold a recording, by name.

    Raises:
        BagError: the run is not a folder.
    """
    if not run_dir.is_dir():
        raise BagError(f"{run_dir}: is not a folder: give the folder of a run")
    return sorted(
        path
        for path in run_dir.iterdir()
        if path.is_dir() and ((path / "metadata.yaml").exists() or any(path.glob("*.mcap")))
    )


def _require_distinct(recordings: Sequence[TrialRecording]) -> None:
    names = [recording.name for recording in recordings]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"two bags are named {twice[0]}: their videos would overwrite each other")


def _read_all(bags: Sequence[Path]) -> tuple[list[TrialRecording], list[SkippedBag]]:
    recordings, skipped = [], []
    for bag in bags:
        try:
            recordings.append(read_trial(bag))
        except BagError as error:
            skipped.append(SkippedBag(bag, str(error)))
    return recordings, skipped


def _portraits(recordings: Sequence[TrialRecording]) -> dict[str, bytes]:
    """A picture of each gripper's fingers, JPEG, where there is more than one to tell apart."""
    first = {recording.gripper: recording for recording in reversed(recordings)}
    return {name: finger_portrait(trial) for name, trial in first.items()} if len(first) > 1 else {}


def _camera_video(recording: TrialRecording, folder: Path) -> Path | None:
    topic = camera_topic(recording.bag)
    if topic is None:
        return None
    return write_camera_video(recording, folder / f"{recording.name}-camera.mp4", topic)


def _render_all(
    recordings: Sequence[TrialRecording],
    folder: Path,
    size: tuple[int, int],
    progress: Progress | None,
) -> list[TrialResult]:
    maximum = stress_ceiling(recordings)
    total = sum(frame_count(recording) for recording in recordings)
    done = 0
    results = []
    for recording in recordings:

        def report(frame: int, _: int, before: int = done, name: str = recording.name) -> None:
            if progress:
                progress(before + frame, total, name)

        metrics = trial_metrics(recording)
        video = folder / f"{recording.name}.mp4"
        write_video(
            recording, video, stress_max=maximum, width=size[0], height=size[1], progress=report
        )
        results.append(TrialResult(recording, metrics, video, _camera_video(recording, folder)))
        done += frame_count(recording)
    return results
