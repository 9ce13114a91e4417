"""One self-contained HTML page and a JSON summary of a run's trials."""

import base64
import io
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from codesign_policy import metrics as definitions
from codesign_policy.files import write_text
from codesign_policy.metrics import GraspMetrics
from codesign_report.charts import Chart, Drawing, draw, limits
from codesign_report.comparison import GripperResult, Labelled, compare
from codesign_report.recording import PoseEstimates, TrialRecording
from codesign_report.trial_charts import own_charts, shared_charts


@dataclass(frozen=True)
class TrialResult:
    """A recording, its metrics, its video and its camera's (None: there is none)."""

    recording: TrialRecording
    metrics: GraspMetrics
    video: Path | None = None
    camera_video: Path | None = None


@dataclass(frozen=True)
class SkippedBag:
    """A bag that could not be used, and why."""

    bag: Path
    reason: str


def write_report(
    trials: Sequence[TrialResult],
    path: str | Path,
    skipped: Sequence[SkippedBag] = (),
    portraits: Mapping[str, bytes] | None = None,
) -> Path:
    """Write one HTML page with everything in it: no file beside it, nothing from the network.

    Trials with the same seed stand side by side, over charts that hold the curves of all of them.

    Args:
        trials: at least one.
        path: of the page.
        skipped: bags that are named as left out.
        portraits: pictures of the fingers, JPEG, by gripper.

    Raises:
        ValueError: no trials.
        OSError: a video can't be read or the page not written.
    """
    if not trials:
        raise ValueError("trials is empty: give at least one")
    grippers = compare(_labelled(trials))
    order = [gripper.gripper for gripper in grippers]
    seeds = _seeds(trials, order)
    page = (
        _environment()
        .get_template("report.html")
        .render(
            trials=[card.result for seed in seeds for card in seed.cards],
            seeds=seeds,
            grippers=grippers,
            colors={name: k for k, name in enumerate(order)},
            portraits={k: data_uri("image/jpeg", jpeg) for k, jpeg in (portraits or {}).items()},
            skipped=skipped,
            size=_object_size(trials[0].recording),
            definitions=definitions,
        )
    )
    write_text(Path(path), page)
    return Path(path)


def _labelled(trials: Sequence[TrialResult]) -> list[Labelled]:
    return [Labelled(r.recording.gripper, r.recording.seed, r.metrics) for r in trials]


def write_summary(
    trials: Sequence[TrialResult], path: str | Path, skipped: Sequence[SkippedBag] = ()
) -> Path:
    """Write {"trials": [...], "grippers": [...], "skipped": [...]} as JSON.

    Units are in the names of the keys, paths relative to the file; null: not defined, such as the
    stress of a finger that never touched.
    """
    target = Path(path)
    folder = target.resolve().parent
    summary = {
        "trials": [_summary(result, folder) for result in trials],
        "grippers": [_gripper_summary(result) for result in compare(_labelled(trials))],
        "skipped": [{"bag": _relative(s.bag, folder), "reason": s.reason} for s in skipped],
    }
    write_text(target, json.dumps(_no_nan(summary), indent=2) + "\n")
    return target


# -- summary -------------------------------------------------------------------------------------


def _summary(result: TrialResult, folder: Path) -> dict[str, Any]:
    trial, metrics = result.recording, result.metrics
    domain = asdict(trial.domain)
    return {
        "gripper": trial.gripper,
        "seed": trial.seed,
        "success": metrics.success,
        "top10_stress_pa": metrics.top10_stress,
        "median_stress_pa": metrics.median_stress,
        "peak_lift_m": metrics.peak_lift,
        "bag": _relative(trial.bag, folder),
        "video": _relative(result.video, folder) if result.video else None,
        "held_force_n": metrics.held_force,
        "weight_n": trial.weight,
        "interaction_time_s": metrics.interaction_time,
        "score": metrics.score,
        **_camera_summary(trial.estimates),
        "domain": {
            "young_modulus_pa": domain["young_modulus"],
            "poisson_ratio": domain["poisson_ratio"],
            "density_kg_m3": domain["density"],
            "friction": domain["friction"],
            "x_m": domain["x"],
            "y_m": domain["y"],
            "yaw_rad": domain["yaw"],
        },
    }


def _camera_summary(estimates: PoseEstimates | None) -> dict[str, Any]:
    """How a camera's estimates were; nothing without one."""
    if estimates is None:
        return {}
    return {
        "camera": {
            "pose_error_median_m": estimates.percentile(50),
            "pose_error_p95_m": estimates.percentile(95),
            "pose_error_max_m": estimates.percentile(100),
            "pictures_used": len(estimates.times),
            "pictures_rejected": len(estimates.rejected),
        }
    }


def _gripper_summary(result: GripperResult) -> dict[str, Any]:
    return {
        "gripper": result.gripper,
        "trials": result.trials,
        "success_rate": result.success_rate,
        "top10_stress_pa": result.top10[0],
        "top10_std_pa": result.top10[1],
        "median_stress_pa": result.median[0],
        "median_std_pa": result.median[1],
        "score": result.score,
        "baseline": result.baseline or None,
        "top10_ratio": result.top10_ratio,
        "median_ratio": result.median_ratio,
    }


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder)).as_posix()


def _no_nan(value: Any) -> Any:
    """JSON has no NaN: null says the same."""
    if isinstance(value, dict):
        return {key: _no_nan(v) for key, v in value.items()}
    if isinstance(value, list):
        return [_no_nan(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# -- page ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Card:
    result: TrialResult
    video: str
    poster: str
    camera_video: str = ""


@dataclass(frozen=True)
class _Seed:
    """Trials of one seed, one card each, and the charts of all of them."""

    seed: int
    cards: list[_Card]
    charts: list[Drawing]


def _seeds(results: Sequence[TrialResult], order: Sequence[str]) -> list[_Seed]:
    """By seed, grippers in the given order; charts of the same kind share one scale."""
    ordered = sorted(results, key=lambda r: (r.recording.seed, order.index(r.recording.gripper)))
    groups = [list(group) for _, group in groupby(ordered, key=lambda r: r.recording.seed)]
    charts = [_charts([r.recording for r in group]) for group in groups]
    everything = [chart for own in charts for chart in own]
    axes = {
        kind: limits([chart for chart in everything if chart.title == kind])
        for kind in {chart.title for chart in everything}
    }
    return [
        _Seed(
            group[0].recording.seed,
            [_card(result) for result in group],
            _drawings([r.recording for r in group], own, axes),
        )
        for group, own in zip(groups, charts, strict=True)
    ]


def _charts(trials: Sequence[TrialRecording]) -> list[Chart]:
    return own_charts(trials[0]) if len(trials) == 1 else shared_charts(trials)


def _drawings(
    trials: Sequence[TrialRecording],
    charts: Sequence[Chart],
    axes: dict[str, tuple[float, float]],
) -> list[Drawing]:
    start = min(float(trial.motion.times[0]) for trial in trials)
    stop = max(float(trial.motion.times[-1]) for trial in trials)
    return [draw(chart, start, stop, axes[chart.title]) for chart in charts]


def _card(result: TrialResult) -> _Card:
    seen = ""
    if result.camera_video:
        seen = data_uri("video/mp4", result.camera_video.read_bytes())
    if not result.video:
        return _Card(result, "", "", seen)
    trial = result.recording
    video = data_uri("video/mp4", result.video.read_bytes())
    worst = trial.stress.times[int(np.argmax(trial.stress.top10))]
    still = _still(result.video, float(worst - trial.motion.times[0]))
    return _Card(result, video, data_uri("image/jpeg", still), seen)


def _object_size(trial: TrialRecording) -> str:
    extent = np.ptp(trial.soft_body.rest_positions, axis=0)
    return " × ".join(f"{1e3 * e:.0f}" for e in extent) + " mm"


def _still(video: Path, time: float) -> bytes:
    """The picture at a time [s], as JPEG: shown before playing and on paper."""
    import av

    with av.open(str(video)) as container:
        image = None
        for frame in container.decode(video=0):
            image = frame
            if (frame.time or 0.0) >= time:
                break
        if image is None:
            raise ValueError(f"{video}: holds no picture: render it again")
        jpeg = io.BytesIO()
        image.to_image().save(jpeg, "JPEG", quality=82)
        return jpeg.getvalue()


def data_uri(kind: str, data: bytes) -> str:
    """Data as a URI that holds it."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"


def _environment() -> Any:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("codesign_report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = number
    environment.filters["curve_data"] = lambda curve: [curve.times, curve.values]
    return environment


def number(value: float, decimals: int = 0) -> str:
    """A number for people: thin groups of thousands, a true minus; a dash if not defined."""
    if not math.isfinite(value):
        return "–"
    text = f"{value:,.{decimals}f}"
    return text.replace(",", "\u202f").replace("-", "\u2212")
