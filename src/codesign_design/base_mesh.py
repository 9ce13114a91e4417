"""Base meshes: the closed surfaces that a cage deforms, generated in unit space.

The unit sphere is the paper's; the torus is its future work; the rounded box has flat faces and
lip and wide a flat contact face with a supporting lip, because neither can be had from a sphere
moved by few handles. Axes are those of the grasp frame: x sideways, y away from the object (the
contact side faces -y), z along the approach. One unit becomes `UNIT_LENGTH` in a design space.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import Delaunay

UNIT_LENGTH = 0.024  # m per unit: the unit sphere becomes a finger 48 mm long

TORUS_RADIUS, TUBE_RADIUS = 0.7, 0.3

BOX_SIZE = np.array([32.0, 14.0, 48.0])  # mm
BOX_EDGE_RADIUS = 1.5  # mm


@dataclass(frozen=True)
class LProfile:
    """A plate on a lip, with rounded corners, extruded sideways. Lengths in millimetres.

    Attributes:
        width, depth, height: of the plate.
        lip: length in front of the contact face.
        tip: thickness left at the lip's tip.
        tip_radius: of both corners there.
        spacing, layer: of the mesh, along the profile and sideways.
        thickness: of the lip.
        chamfer: length over which the lip thins towards its tip.
    """

    width: float
    depth: float
    height: float
    lip: float
    tip: float
    tip_radius: float
    spacing: float
    layer: float
    thickness: float = 1.5
    chamfer: float = 7.0


LIP = LProfile(32.0, 8.0, 48.0, 10.5, tip=0.6, tip_radius=0.25, spacing=0.9, layer=1.4)
# As wide as the scoop of the experts and with its thin tip: stretched to that width, `LIP` bows and
# its tip stands half a millimetre above the table, and blocks jam on it.
WIDE = LProfile(60.0, 7.0, 48.0, 12.0, tip=0.35, tip_radius=0.12, spacing=1.25, layer=1.75)


@dataclass(frozen=True)
class BaseMesh:
    """A closed surface in unit space: vertices (V, 3) float64, faces (F, 3) int32."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]


def base_mesh_names() -> list[str]:
    """Every base mesh there is."""
    return sorted(_MAKERS)


@cache
def base_mesh(name: str) -> BaseMesh:
    """The base mesh of that name.

    Raises:
        ValueError: no such base mesh.
    """
    if name not in _MAKERS:
        raise ValueError(f"no base mesh {name!r}; choose from {', '.join(base_mesh_names())}")
    return _MAKERS[name]()


def _sphere() -> BaseMesh:
    sphere = trimesh.creation.icosphere(subdivisions=4)
    return BaseMesh(sphere.vertices.copy(), sphere.faces.astype(np.int32))


def _torus() -> BaseMesh:
    """Around the y axis: a ring whose hole faces the object."""
    around, tube = 88, 36
    u, v = np.meshgrid(
        2 * np.pi * np.arange(around) / around, 2 * np.pi * np.arange(tube) / tube, indexing="ij"
    )
    radius = TORUS_RADIUS + TUBE_RADIUS * np.cos(v)
    points = [radius * np.sin(u), TUBE_RADIUS * np.sin(v), radius * np.cos(u)]
    index = np.arange(around * tube).reshape(around, tube)
    quads = [index, np.roll(index, -1, 0), np.roll(index, (-1, -1), (0, 1)), np.roll(index, -1, 1)]
    return _outward(np.stack(points, -1).reshape(-1, 3), _split(quads))


def _box() -> BaseMesh:
    """A grid on each face of a cuboid, its edges pushed onto the fillets."""
    half = BOX_SIZE / 2
    lines = [_box_lines(h) for h in half]
    patches = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        grid = np.stack(np.meshgrid(lines[u], lines[v], indexing="ij"), -1)
        index = np.arange(grid[..., 0].size).reshape(grid.shape[:2])
        quads = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
        for side in (-1.0, 1.0):
            points = np.zeros((index.size, 3))
            points[:, axis] = side * half[axis]
            points[:, [u, v]] = grid.reshape(-1, 2)
            faces = _split(quads)
            patches.append((points, faces if side > 0 else faces[:, ::-1]))
    points, faces = _joined(patches)
    core = np.clip(points, BOX_EDGE_RADIUS - half, half - BOX_EDGE_RADIUS)
    outward = points - core
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    return _outward((core + BOX_EDGE_RADIUS * outward) / (UNIT_LENGTH * 1e3), faces)


def _box_lines(half: float) -> NDArray[np.float64]:
    """Grid lines across a face: three on each fillet, about 1.7 mm apart between them."""
    flat = half - BOX_EDGE_RADIUS
    middle = np.linspace(-flat, flat, 2 * round(flat / 1.7) + 1)
    fillet = BOX_EDGE_RADIUS * np.tan(np.pi / 12 * np.array([1.0, 2.0, 3.0]))
    return np.concatenate([-flat - fillet[::-1], middle, flat + fillet])


def _lip() -> BaseMesh:
    return _extruded(LIP)


def _wide() -> BaseMesh:
    return _extruded(WIDE)


def _extruded(profile: LProfile) -> BaseMesh:
    """The body of a profile; the lip is at the lower end (+z)."""
    outline = _l_outline(profile)
    inside = _grid_inside(outline, profile.spacing * 1.6)
    cap = np.concatenate([outline, inside])
    triangles = Delaunay(cap).simplices
    triangles = triangles[_contains(outline, cap[triangles].mean(1))]
    half = profile.width / 2
    layers = np.linspace(-half, half, 2 * round(half / profile.layer) + 1)
    count = len(outline)
    ring = np.arange(count * len(layers)).reshape(len(layers), count)
    wall = np.column_stack([np.repeat(layers, count), np.tile(outline, (len(layers), 1))])
    after = np.roll(ring, -1, 1)
    patches = [(wall, _split([ring[:-1], after[:-1], after[1:], ring[1:]]))]
    for x, turned in ((-half, triangles[:, ::-1]), (half, triangles)):
        patches.append((np.column_stack([np.full(len(cap), x), cap]), turned))
    points, faces = _joined(patches)
    return _outward(points / (UNIT_LENGTH * 1e3), faces)


def _l_outline(profile: LProfile) -> NDArray[np.float64]:
    """The profile in (y, z) [mm], (K, 2), evenly spaced, counter-clockwise."""
    depth, bottom = profile.depth + profile.lip, profile.height / 2
    front, tip = depth / 2 - profile.depth, -depth / 2
    corners = np.array(
        [
            [depth / 2, -bottom],
            [depth / 2, bottom],
            [tip, bottom],
            [tip, bottom - profile.tip],
            [tip + profile.chamfer, bottom - profile.thickness],
            [front, bottom - profile.thickness],
            [front, -bottom],
        ]
    )
    radii = np.array([1.5, 1.0, profile.tip_radius, profile.tip_radius, 2.0, 1.0, 1.5])
    return _resampled(_rounded(corners, radii), profile.spacing)


def _rounded(corners: NDArray[np.float64], radii: NDArray[np.float64]) -> NDArray[np.float64]:
    """A polygon with its corners replaced by arcs of the given radii [mm]."""
    points = []
    for before, corner, after, radius in zip(
        np.roll(corners, 1, 0), corners, np.roll(corners, -1, 0), radii, strict=True
    ):
        a, b = before - corner, after - corner
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        half_angle = np.arccos(np.clip(a @ b, -1, 1)) / 2
        bisector = (a + b) / np.linalg.norm(a + b)
        centre = corner + bisector * radius / np.sin(half_angle)
        start = corner + a * radius / np.tan(half_angle) - centre
        end = corner + b * radius / np.tan(half_angle) - centre
        turn = np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end)
        for angle in np.linspace(0.0, turn, 2 + int(radius * abs(turn) / 0.6)):
            cos, sin = np.cos(angle), np.sin(angle)
            points.append(centre + start @ np.array([[cos, sin], [-sin, cos]]))
    return np.array(points)


def _resampled(polygon: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """The polygon with its edges divided so that none is longer than `spacing`."""
    points = []
    for start, end in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        parts = max(1, int(np.ceil(np.linalg.norm(end - start) / spacing)))
        points.append(start + (end - start) * np.arange(parts)[:, None] / parts)
    return np.concatenate(points)


def _grid_inside(outline: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Grid points inside the outline, none closer to it than half the spacing."""
    low, high = outline.min(0), outline.max(0)
    axes = [np.arange(a + spacing / 2, b, spacing) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    away = np.linalg.norm(grid[:, None] - outline, axis=-1).min(1) > spacing / 2
    return grid[away & _contains(outline, grid)]


def _contains(polygon: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether each point is inside the polygon, by counting crossed edges."""
    start, end = polygon, np.roll(polygon, -1, 0)
    p = points[:, None]
    spans = (start[:, 1] > p[..., 1]) != (end[:, 1] > p[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (end[:, 0] - start[:, 0]) / (end[:, 1] - start[:, 1])
        left = p[..., 0] < start[:, 0] + slope * (p[..., 1] - start[:, 1])
    return (spans & left).sum(1) % 2 == 1


def _split(quads: list[NDArray[np.int_]]) -> NDArray[np.int_]:
    """Two triangles for each quad a, b, c, d given by its four corner index arrays."""
    a, b, c, d = (corner.ravel() for corner in quads)
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])


def _joined(
    patches: list[tuple[NDArray[np.float64], NDArray[np.int_]]],
) -> tuple[NDArray[np.float64], NDArray[np.int_]]:
    """Patches that meet at equal points, as one mesh."""
    starts = np.cumsum([0] + [len(points) for points, _ in patches[:-1]])
    points = np.concatenate([points for points, _ in patches])
    faces = np.concatenate(
        [faces + start for (_, faces), start in zip(patches, starts, strict=True)]
    )
    _, first, merged = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    return points[first], merged.ravel()[faces]


def _outward(points: NDArray[np.float64], faces: NDArray[np.int_]) -> BaseMesh:
    """Turns a consistently wound surface so that it encloses a positive volume."""
    a, b, c = points[faces].transpose(1, 0, 2)
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        faces = faces[:, ::-1]
    return BaseMesh(points, np.ascontiguousarray(faces, dtype=np.int32))


_MAKERS: dict[str, Callable[[], BaseMesh]] = {
    "sphere": _sphere,
    "torus": _torus,
    "box": _box,
    "lip": _lip,
    "wide": _wide,
}
