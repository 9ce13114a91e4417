"""From the bags of a run to videos, summary and report."""

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codesign_report.bag import BagError, read_trial, trial_metrics
from codesign_report.camera_view import camera_topic, write_camera_video
from codesign_report.portrait import finger_portrait
from codesign_report.recording import TrialRecording
from codesign_report.report import SkippedBag, TrialResult, write_report, write_summary
from codesign_report.video import frame_count, stress_ceiling, write_video

Progress = Callable[[int, int, str], None]

ALONE, SIDE_BY_SIDE = (1280, 720), (960, 540)
"""Width and height of videos [px]: of one gripper, and of several, which share the page's width."""

PROGRESS_PERIOD = 0.2  # s, between looks at what other processes have done

_pictures: Any = None  # in a process of the pool: counts the pictures of all


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
    processes: int = 1,
) -> RunReport:
    """Render a video per trial and write summary.json and report.html into the run's folder.

    All videos share one colour scale. Bags that can't be used are named in the report; the others
    still appear.

    Args:
        run_dir: folder to write to.
        trials: bags; None: every bag folder directly in `run_dir`.
        progress: called with pictures done, pictures in total and what is being done.
        size: width and height of the videos, even [px]; None: `ALONE` or `SIDE_BY_SIDE`.
        processes: that render videos side by side. More than one: the calling script needs the
            usual `if __name__ == "__main__"`.

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
    results = _render_all(recordings, folder, size, progress, processes)
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
    processes: int,
) -> list[TrialResult]:
    maximum = stress_ceiling(recordings)
    total = sum(frame_count(recording) for recording in recordings)
    tell = progress or (lambda done, total, what: None)
    jobs = [(recording, folder, size, maximum) for recording in recordings]
    processes = min(processes, len(jobs))
    if processes > 1:
        return _in_processes(jobs, processes, lambda done, what: tell(done, total, what))
    results: list[TrialResult] = []
    for job in jobs:
        before = sum(frame_count(result.recording) for result in results)

        def told(frame: int, before: int = before, name: str = job[0].name) -> None:
            tell(before + frame, total, name)

        results.append(_render(*job, told))
    return results


def _render(
    recording: TrialRecording,
    folder: Path,
    size: tuple[int, int],
    maximum: float,
    told: Callable[[int], None],
) -> TrialResult:
    """One trial's videos; `told` hears how many pictures are done."""
    video = folder / f"{recording.name}.mp4"
    write_video(
        recording,
        video,
        stress_max=maximum,
        width=size[0],
        height=size[1],
        progress=lambda frame, _: told(frame),
    )
    return TrialResult(recording, trial_metrics(recording), video, _camera_video(recording, folder))


def _in_processes(
    jobs: Sequence[tuple[TrialRecording, Path, tuple[int, int], float]],
    processes: int,
    tell: Callable[[int, str], None],
) -> list[TrialResult]:
    """The same in processes of their own: a picture is drawn by one thread."""
    context = multiprocessing.get_context("spawn")
    pictures = context.Value("l", 0)
    with ProcessPoolExecutor(processes, context, _count_in, (pictures,)) as pool:
        futures = [pool.submit(_render_counted, *job) for job in jobs]
        pending = set(futures)
        while pending:
            done, pending = wait(pending, PROGRESS_PERIOD, return_when=FIRST_EXCEPTION)
            failed = next((f for f in done if f.exception() is not None), None)
            if failed is not None:
                pool.shutdown(cancel_futures=True)
                failed.result()
            tell(pictures.value, f"{len(jobs) - len(pending)} of {len(jobs)} videos done")
        return [future.result() for future in futures]


def _count_in(pictures: Any) -> None:
    global _pictures
    _pictures = pictures


def _render_counted(
    recording: TrialRecording, folder: Path, size: tuple[int, int], maximum: float
) -> TrialResult:
    """`_render` in a process of the pool."""
    counted = 0

    def told(frame: int) -> None:
        nonlocal counted
        with _pictures.get_lock():
            _pictures.value += frame - counted
        counted = frame

    return _render(recording, folder, size, maximum, told)
