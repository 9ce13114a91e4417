"""A finger pair's report as one self-contained HTML page with pictures."""

from __future__ import annotations

import base64
import json
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from jinja2 import Environment, PackageLoader, select_autoescape
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

_VIEWS = {"contact side": (20, -75), "mount side": (20, 105), "side": (5, 0)}  # elevation, azimuth
_LIGHT = np.array([0.3, -0.5, 0.8])


def finger_page(
    report: dict[str, Any], vertices: NDArray[np.float64], faces: NDArray[np.int32]
) -> str:
    """The page as text: verdict, pictures, every measure in the report's units.

    Args:
        report: of the finger pair, as in its `report.json`.
        vertices, faces: left finger, (V, 3) [m] and (F, 3).
    """
    environment = Environment(
        loader=PackageLoader("codesign_report", "."), autoescape=select_autoescape()
    )
    groups = {key: value for key, value in report.items() if isinstance(value, dict)}
    return environment.get_template("finger_report.html").render(
        report=report,
        groups=groups,
        picture=base64.b64encode(_picture(vertices[faces] * 1e3)).decode(),
        number=lambda value: f"{value:.6g}" if isinstance(value, float) else json.dumps(value),
    )


def _picture(corners: NDArray[np.float64]) -> bytes:
    """PNG of triangles (F, 3, 3) from three sides, in millimetres."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    figure = Figure(figsize=(12, 4.2))
    figure.subplots_adjust(left=0.02, right=0.95, bottom=0.16, top=0.94, wspace=0.15)
    canvas = FigureCanvasAgg(figure)
    for place, (title, (elevation, azimuth)) in enumerate(_VIEWS.items(), start=1):
        axes = figure.add_subplot(1, len(_VIEWS), place, projection="3d")
        shade = 0.35 + 0.6 * np.abs(normals @ _LIGHT / np.linalg.norm(_LIGHT))
        colours = matplotlib.colormaps["bone"](shade)
        axes.add_collection3d(Poly3DCollection(corners, facecolors=colours))
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set(title=title, xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
        axes.set_box_aspect(np.maximum(high - low, 1e-3))
        axes.locator_params(nbins=4)
        axes.view_init(elevation, azimuth)
    buffer = BytesIO()
    canvas.print_png(buffer)
    return buffer.getvalue()
