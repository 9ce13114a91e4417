"""One self-contained HTML page and a JSON summary of a run's trials."""

import base64
import io
import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from codesign_policy import metrics as definitions
from codesign_policy.files import write_text
from codesign_policy.metrics import GraspMetrics, in_contact, lift, score
from codesign_report.charts import Chart, Drawing, Series, draw, limits
from codesign_report.recording import TrialRecording


@dataclass(frozen=True)
class TrialResult:
    """A recording, its metrics and its video (None: not rendered)."""

    recording: TrialRecording
    metrics: GraspMetrics
    video: Path | None = None


@dataclass(frozen=True)
class SkippedBag:
    """A bag that could not be used, and why."""

    bag: Path
    reason: str


def write_report(
    trials: Sequence[TrialResult], path: str | Path, skipped: Sequence[SkippedBag] = ()
) -> Path:
    """Write one HTML page with everything in it: no file beside it, nothing from the network.

    Trials with the same seed stand side by side.

    Raises:
        ValueError: no trials.
        OSError: a video can't be read or the page not written.
    """
    if not trials:
        raise ValueError("trials is empty: give at least one")
    template = _environment().get_template("report.html")
    ordered = sorted(trials, key=lambda r: (r.recording.seed, r.recording.gripper))
    cards = _cards(ordered)
    by_seed = groupby(cards, key=lambda card: card.result.recording.seed)
    page = template.render(
        trials=ordered,
        seeds=[(seed, list(group)) for seed, group in by_seed],
        grippers=_by_gripper(ordered),
        skipped=skipped,
        size=_object_size(ordered[0].recording),
        definitions=definitions,
    )
    write_text(Path(path), page)
    return Path(path)


def write_summary(
    trials: Sequence[TrialResult], path: str | Path, skipped: Sequence[SkippedBag] = ()
) -> Path:
    """Write {"trials": [...], "skipped": [...]} as JSON.

    Units are in the names of the keys, paths relative to the file; null: not defined, such as the
    stress of a finger that never touched.
    """
    target = Path(path)
    folder = target.resolve().parent
    summary = {
        "trials": [_summary(result, folder) for result in trials],
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
    charts: list[Drawing]
    video: str
    poster: str


@dataclass(frozen=True)
class _Aggregate:
    """A gripper over its trials: mean and standard deviation, as in the paper's table I."""

    gripper: str
    count: int
    success_rate: float
    top10: tuple[float, float]
    median: tuple[float, float]
    score: float


def _cards(results: Sequence[TrialResult]) -> list[_Card]:
    """One per trial; charts of the same kind share one scale, so that they can be compared."""
    charts = [_charts(result.recording) for result in results]
    kinds = {chart.title for trial in charts for chart in trial}
    axes = {
        kind: limits([c for trial in charts for c in trial if c.title == kind]) for kind in kinds
    }
    return [_card(result, own, axes) for result, own in zip(results, charts, strict=True)]


def _card(
    result: TrialResult, charts: Sequence[Chart], axes: dict[str, tuple[float, float]]
) -> _Card:
    trial = result.recording
    start, stop = trial.motion.times[[0, -1]].tolist()
    drawings = [draw(chart, start, stop, axes[chart.title]) for chart in charts]
    video = poster = ""
    if result.video:
        video = _data_uri("video/mp4", result.video.read_bytes())
        worst = trial.stress.times[int(np.argmax(trial.stress.top10))]
        poster = _data_uri("image/jpeg", _still(result.video, float(worst) - start))
    return _Card(result, drawings, video, poster)


def _charts(trial: TrialRecording) -> list[Chart]:
    stress = trial.stress
    t = stress.times
    contact = in_contact(stress.left_force, stress.right_force)
    touching = t[contact]
    band = (float(touching[0]), float(touching[-1])) if len(touching) else None
    left, right = (np.linalg.norm(f, axis=1) for f in (stress.left_force, stress.right_force))
    upward = stress.left_force[:, 2] + stress.right_force[:, 2]
    charts = [
        Chart(
            "Von Mises stress",
            "Pa",
            [Series("top 10 %", t, stress.top10), Series("median", t, stress.median)],
            band=band,
        ),
        Chart(
            "Finger force on the object",
            "N",
            [
                Series("left", t, left),
                Series("right", t, right),
                Series("both, upward", t, upward),
            ],
            level=("weight", trial.weight),
            band=band,
            decimals=2,
        ),
        Chart(
            "Lift",
            "mm",
            [Series("object's centre", t, 1e3 * lift(trial.object_height, contact))],
            level=("picked up", 1e3 * definitions.SUCCESS_LIFT),
            band=band,
            decimals=1,
        ),
    ]
    if len(trial.gripper_times):
        gap = Series("between the fingers", trial.gripper_times, 1e3 * trial.gripper_width)
        charts.append(Chart("Gripper gap", "mm", [gap], band=band, decimals=1))
    return charts


def _by_gripper(trials: Sequence[TrialResult]) -> list[_Aggregate]:
    ordered = sorted(trials, key=lambda r: r.recording.gripper)
    return [
        _aggregate(name, [r.metrics for r in group])
        for name, group in groupby(ordered, key=lambda r: r.recording.gripper)
    ]


def _aggregate(gripper: str, metrics: Sequence[GraspMetrics]) -> _Aggregate:
    rate = float(np.mean([m.success for m in metrics]))
    top10 = _spread(m.top10_stress for m in metrics)
    median = _spread(m.median_stress for m in metrics)
    return _Aggregate(gripper, len(metrics), rate, top10, median, score(rate, top10[0]))


def _spread(values: Iterable[float]) -> tuple[float, float]:
    """Mean and standard deviation of the values that are defined."""
    defined = [v for v in values if math.isfinite(v)]
    if not defined:
        return math.nan, math.nan
    return float(np.mean(defined)), float(np.std(defined))


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


def _data_uri(kind: str, data: bytes) -> str:
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
