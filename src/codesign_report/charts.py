"""Time series as inline SVG: no plotting library, styled and animated by the page around it."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from codesign_report.overlay import nice_ceiling, nice_ticks
from codesign_report.recording import Floats

WIDTH, HEIGHT = 640, 150
LEFT, RIGHT, TOP, BOTTOM = 58, 628, 10, 124
"""Plot area within the picture [px of the viewBox]."""


@dataclass(frozen=True)
class Series:
    """A curve: name, times (T,) [s] and values (T,) in the chart's unit.

    color, dash: 0 to 2, of the page's style; None: the curve's place in its chart.
    """

    name: str
    times: Floats
    values: Floats
    color: int | None = None
    dash: int | None = None


@dataclass(frozen=True)
class Chart:
    """Curves over a common time axis, with optional level to compare with.

    Attributes:
        title: with no unit.
        unit: of the values.
        series: curves.
        level: (name, value) of a horizontal line.
        band: (start, stop) of the shaded time [s].
        decimals: of the values shown at the cursor.
    """

    title: str
    unit: str
    series: Sequence[Series]
    level: tuple[str, float] | None = None
    band: tuple[float, float] | None = None
    decimals: int = 0


@dataclass(frozen=True)
class Curve:
    """One drawn curve: its path and what the cursor reads."""

    name: str
    path: str
    times: list[float]
    values: list[float]
    color: int
    dash: int


@dataclass(frozen=True)
class Drawing:
    """A chart laid out in viewBox pixels, for the template."""

    chart: Chart
    curves: list[Curve]
    y_ticks: list[tuple[float, str]]
    x_ticks: list[tuple[float, str]]
    level: float | None
    band: tuple[float, float] | None
    start: float
    stop: float
    alt: str


def limits(charts: Collection[Chart]) -> tuple[float, float]:
    """Round ends of a y axis that fits all the charts; 0 is always on it."""
    values = [s.values for chart in charts for s in chart.series]
    values += [np.array([c.level[1]]) for c in charts if c.level and np.isfinite(c.level[1])]
    low = min(0.0, *(float(v.min()) for v in values))
    top = nice_ceiling(max(0.0, *(float(v.max()) for v in values)))
    # A little below 0 is noise: it is not worth a longer axis.
    return (-nice_ceiling(-low) if low < -0.05 * top else 0.0), top


def draw(chart: Chart, start: float, stop: float, axis: tuple[float, float]) -> Drawing:
    """Lay a chart out over the time from `start` to `stop` [s] and the values of `axis`."""
    bottom, top = axis
    span = max(stop - start, 1e-9)

    def x(t: float) -> float:
        return round(LEFT + (RIGHT - LEFT) * (t - start) / span, 1)

    def y(value: float) -> float:
        share = (np.clip(value, bottom, top) - bottom) / (top - bottom)
        return round(float(BOTTOM - (BOTTOM - TOP) * share), 1)

    ticks = [-v for v in nice_ticks(-bottom, 3)[:0:-1]] if bottom < 0.0 else []
    level = y(chart.level[1]) if chart.level and np.isfinite(chart.level[1]) else None
    return Drawing(
        chart=chart,
        curves=[_curve(s, k, x, y) for k, s in enumerate(chart.series)],
        y_ticks=[(y(v), _label(v)) for v in [*ticks, *nice_ticks(top, 4)]],
        x_ticks=[(x(start + v), _label(v)) for v in nice_ticks(span, 9)[:-1]],
        level=level,
        band=(x(chart.band[0]), x(chart.band[1])) if chart.band else None,
        start=start,
        stop=stop,
        alt=_alt(chart),
    )


def _curve(series: Series, place: int, x, y) -> Curve:  # type: ignore[no-untyped-def]
    points = [f"{x(t)},{y(v)}" for t, v in zip(series.times, series.values, strict=True)]
    return Curve(
        series.name,
        "M" + "L".join(points),
        [round(float(t), 3) for t in series.times],
        [float(f"{v:.5g}") for v in series.values],
        place if series.color is None else series.color,
        place if series.dash is None else series.dash,
    )


def _label(value: float) -> str:
    text = f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
    return text.replace(",", " ").replace("-", "−")


def _alt(chart: Chart) -> str:
    """What the chart shows, in words."""
    parts = [
        f"{s.name} from {_label(s.values.min())} to {_label(s.values.max())} {chart.unit}"
        for s in chart.series
    ]
    return f"{chart.title} over time: {'; '.join(parts)}."
