"""Where a closed surface crosses the columns of a regular grid.

A column is a line parallel to one axis through a point of a regular grid across the other two. The
signed crossings give the exact winding number at every point of the column (1 inside, 0 outside,
more where the surface overlaps itself, negative where it is turned inside out), and depth maps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import TriangleMesh


@dataclass(frozen=True)
class Columns:
    """Columns along `axis` through the grid of `first` x `second` coordinates [m].

    `first` belongs to axis + 1, `second` to axis + 2 (cyclic); both are evenly spaced.
    """

    axis: int
    first: NDArray[np.float64]
    second: NDArray[np.float64]

    @property
    def count(self) -> int:
        return len(self.first) * len(self.second)


@dataclass(frozen=True)
class Crossings:
    """Every crossing, K of them: its column, coordinate along the axis [m], and direction.

    `column` indexes the flattened (first, second) grid. `sign` is 1 where the surface faces along
    the axis, so that the axis leaves the solid, and -1 where it enters.
    """

    column: NDArray[np.int64]
    height: NDArray[np.float64]
    sign: NDArray[np.int64]


def crossings(surface: TriangleMesh, columns: Columns) -> Crossings:
    """Crossings of the surface with each column.

    A column that runs through an edge is given to exactly one of the triangles that meet there, so
    the signs of every column of a closed surface add up to zero.
    """
    u_axis, v_axis = (columns.axis + 1) % 3, (columns.axis + 2) % 3
    u, v = surface.vertices[:, u_axis], surface.vertices[:, v_axis]
    face, i, j = _candidates(u[surface.faces], v[surface.faces], columns)
    corners = surface.faces[face]
    pu, pv = columns.first[i], columns.second[j]
    area = _area(u[corners], v[corners])
    inside = area != 0
    weights = np.empty((len(face), 3))
    for k in range(3):
        start, end = corners[:, (k + 1) % 3], corners[:, (k + 2) % 3]
        edge, left = _side(u, v, start, end, pu, pv)
        inside &= left == ((start < end) == (area > 0))
        weights[:, k] = edge
    face, weights, area = face[inside], weights[inside], area[inside]
    heights = surface.vertices[:, columns.axis][surface.faces[face]]
    height = (weights * heights).sum(1) / weights.sum(1)
    column = (i * len(columns.second) + j)[inside]
    return Crossings(column, height, np.sign(area).astype(np.int64))


def winding_numbers(
    surface: TriangleMesh, columns: Columns, levels: NDArray[np.float64]
) -> NDArray[np.int16]:
    """Winding number at (first, second, level), levels rising along the axis [m]."""
    found = crossings(surface, columns)
    below = np.searchsorted(levels, found.height) - 1  # a crossing counts for all levels below it
    inside = below >= 0
    cell = found.column[inside] * len(levels) + below[inside]
    total = np.bincount(cell, found.sign[inside], columns.count * len(levels))
    steps = total.reshape(len(columns.first), len(columns.second), len(levels)).astype(np.int16)
    return np.cumsum(steps[..., ::-1], axis=-1, dtype=np.int16)[..., ::-1]


def _candidates(
    u: NDArray[np.float64], v: NDArray[np.float64], columns: Columns
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Each triangle with each column in its bounding rectangle: face, index in first, in second."""
    i0, i1 = _range(u, columns.first)
    j0, j1 = _range(v, columns.second)
    rows, width = np.maximum(i1 - i0, 0), np.maximum(j1 - j0, 0)
    count = rows * width
    face = np.repeat(np.arange(len(u)), count)
    place = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    return face, i0[face] + place // width[face], j0[face] + place % width[face]


def _range(
    corners: NDArray[np.float64], grid: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    low = np.searchsorted(grid, corners.min(1), side="left")
    return low, np.searchsorted(grid, corners.max(1), side="right")


def _side(
    u: NDArray[np.float64],
    v: NDArray[np.float64],
    start: NDArray[np.signedinteger],
    end: NDArray[np.signedinteger],
    pu: NDArray[np.float64],
    pv: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Twice the area of edge and point, and whether the point is left of the edge.

    The edge is taken from its lower to its higher vertex, so both its triangles get the same
    answer, down to the last bit.
    """
    low, high = np.minimum(start, end), np.maximum(start, end)
    area = (u[high] - u[low]) * (pv - v[low]) - (v[high] - v[low]) * (pu - u[low])
    return np.where(start < end, area, -area), area >= 0


def _area(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice the signed area of triangles, (K, 3) each."""
    return (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (v[:, 1] - v[:, 0]) * (u[:, 2] - u[:, 0])
