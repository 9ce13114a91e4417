"""Pictures of finger designs: cage, handles, surface, distance to a target; as PNG files."""

import os
from pathlib import Path

import numpy as np
import trimesh
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from codesign_design.chamfer import distances_to
from codesign_design.design_space import DesignSpace
from codesign_design.finger_pair import TriangleMesh
from codesign_design.inverse import Fit

_LIGHT = np.array([-0.5, -0.75, -0.45]) / np.linalg.norm([-0.5, -0.75, -0.45])
FINGER, TARGET = (0.93, 0.82, 0.55), (0.62, 0.71, 0.80)


def save(figure: Figure, path: Path) -> None:
    """Writes a PNG in one step."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    figure.savefig(part, format="png", dpi=130)
    os.replace(part, path)


def design_picture(
    space: DesignSpace,
    parameters: NDArray[np.float64],
    target: TriangleMesh | None = None,
) -> Figure:
    """The finger from two sides, its cage with numbered handles, and the target if there is one."""
    surface = space.deformed(parameters)
    panels = 3 if target is None else 5
    figure = Figure(figsize=(3.6 * panels, 4.0))
    figure.subplots_adjust(left=0.01, right=0.98, bottom=0.02, top=0.92, wspace=0.04)
    axes = [figure.add_subplot(1, panels, k + 1, projection="3d") for k in range(panels)]
    everything = [surface.vertices] if target is None else [surface.vertices, target.vertices]
    draw_surface(axes[0], surface, FINGER, bounds=everything)
    axes[0].set_title("contact side")
    draw_surface(axes[1], surface, FINGER, bounds=everything, azimuth=55)
    axes[1].set_title("back")
    handles = space.handles_at(parameters)
    draw_surface(axes[2], surface, FINGER, bounds=[*everything, handles], alpha=0.35)
    _draw_cage(axes[2], space, handles)
    axes[2].set_title(f"{space.name}: cage and handles")
    if target is not None:
        draw_surface(axes[3], target, TARGET, bounds=everything)
        axes[3].set_title("target")
        distance = distances_to(surface.vertices, target) * 1e3
        scale = Normalize(0.0, max(float(np.percentile(distance, 98)), 0.1))
        colours = colormaps["viridis"](scale(distance[surface.faces].mean(axis=1)))[:, :3]
        draw_surface(axes[4], surface, colours, bounds=everything)
        axes[4].set_title("distance to the target [mm]")
        figure.colorbar(ScalarMappable(scale, "viridis"), ax=axes[4], shrink=0.7)
    return figure


def finger_picture(mesh: TriangleMesh) -> Figure:
    """A finger that has no cage, such as the stock one, from two sides."""
    figure = Figure(figsize=(7.2, 4.0))
    figure.subplots_adjust(left=0.01, right=0.98, bottom=0.02, top=0.92, wspace=0.04)
    for k, (azimuth, title) in enumerate(((-125, "contact side"), (55, "back"))):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d")
        draw_surface(axes, mesh, FINGER, bounds=[mesh.vertices], azimuth=azimuth)
        axes.set_title(title)
    return figure


def curve_picture(fit: Fit) -> Figure:
    """How the best restart's Chamfer distance fell."""
    figure = Figure(figsize=(6.0, 3.2), layout="constrained")
    axes = figure.add_subplot()
    axes.semilogy(np.arange(len(fit.curve)), fit.curve * 1e3)
    axes.axhline(fit.chamfer * 1e3, linestyle=":", color="black", linewidth=1)
    axes.set(xlabel="iteration", ylabel="Chamfer distance [mm]", title=f"{fit.space}")
    axes.grid(which="both", alpha=0.3)
    return figure


def draw_surface(
    axes: Axes3D,
    mesh: TriangleMesh,
    colour: tuple[float, float, float] | NDArray[np.float64],
    bounds: list[NDArray[np.float64]],
    alpha: float = 1.0,
    azimuth: float = -125,
) -> None:
    """A shaded surface seen in the grasp frame; the approach direction points down.

    Args:
        colour: one for all faces, or (F, 3).
        bounds: point sets that the view must hold [m].
    """
    triangles, colour = _small_triangles(mesh, np.broadcast_to(colour, mesh.faces.shape))
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    shade = 0.62 + 0.38 * np.clip(normals @ _turned(azimuth), -1.0, 1.0)
    colours = np.clip(np.broadcast_to(colour, normals.shape) * shade[:, None], 0.0, 1.0)
    faces = Poly3DCollection(
        triangles, facecolors=np.column_stack([colours, np.full(len(colours), alpha)])
    )
    faces.set_edgecolor("none" if alpha < 1.0 else colours)
    faces.set_linewidth(0.2)
    axes.add_collection3d(faces)
    points = np.concatenate(bounds) * 1e3
    middle, half = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0).max() / 2
    axes.set(
        xlim=(middle[0] - half, middle[0] + half),
        ylim=(middle[1] - half, middle[1] + half),
        zlim=(middle[2] + half, middle[2] - half),  # downwards
    )
    axes.set_box_aspect((1, 1, 1), zoom=1.2)
    axes.view_init(elev=22, azim=azimuth)
    axes.set_axis_off()


def _small_triangles(
    mesh: TriangleMesh, colours: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners (F, 3, 3) [mm] of triangles at most 4 mm long, which sort well by depth."""
    points, faces, origin = trimesh.remesh.subdivide_to_size(
        mesh.vertices * 1e3, mesh.faces, max_edge=4.0, max_iter=10, return_index=True
    )
    return points[faces], colours[origin]


def _draw_cage(axes: Axes3D, space: DesignSpace, handles: NDArray[np.float64]) -> None:
    faces = space.cage.faces
    edges = np.unique(
        np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1),
        axis=0,
    )
    axes.add_collection3d(Line3DCollection(handles[edges] * 1e3, colors="0.25", linewidths=0.8))
    axes.scatter(*(handles.T * 1e3), color="tab:red", s=14, depthshade=False)
    for index, handle in enumerate(handles * 1e3):
        axes.text(*handle, f" {index}", fontsize=7)


def _turned(azimuth: float) -> NDArray[np.float64]:
    """Direction towards the light, which turns with the viewer."""
    angle = np.deg2rad(azimuth + 125)
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ _LIGHT
