"""The paper's reconstruction (III-A): a surface from points with normals, by Poisson's equation.

Kazhdan, Bolitho and Hoppe 2006, on a regular grid instead of an octree: the normals of sampled
points, spread over the grid, are the gradient of the solid's indicator function; the function with
that gradient solves Poisson's equation, here by a sine transform, and its mean at the points is the
level of the surface. It rounds edges by about a voxel and closes holes smoothly.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.ndimage import map_coordinates

from codesign_design.chamfer import sample_surface
from codesign_design.finger_pair import TriangleMesh
from codesign_design.repair import VOXEL, Repaired, grid_axes, one_piece, piece_of_level

POINTS = 30_000  # that stand for the surface
SPREAD = 1.0  # voxels, standard deviation of a normal's share of the grid
MARGIN = 6.5  # voxels: far enough for the indicator to fade


def reconstruct(
    surface: TriangleMesh, depth: float = np.inf, voxel: float = VOXEL, seed: int = 0
) -> Repaired:
    """The largest piece of the solid that points on a surface suggest, cavities filled.

    Args:
        surface: with outward normals; what lies inside the solid blurs it.
        depth: as of `repair`.
        voxel: grid spacing [m].
        seed: of the points.

    Raises:
        ValueError: no solid is left, for example because the surface is inside out.
    """
    axes, voxel = grid_axes(surface, voxel, MARGIN)
    points, normals = sample_surface(surface, POINTS, seed)
    where = ((points - [axis[0] for axis in axes]) / voxel).T
    shape = tuple(len(axis) for axis in axes)
    indicator = _poisson(_divergence(_spread(where, -normals, shape)))
    level = float(map_coordinates(indicator, where, order=1).mean())
    inside = (indicator > level) & (level > 0.0)  # negative: turned inside out
    solid, lost = one_piece(surface, inside, axes, depth, voxel)
    volume = int(solid.sum()) * voxel**3
    away = np.abs(indicator[:, : solid.shape[1]] - level)
    field = np.where(solid, -away, away)
    return Repaired(piece_of_level(field, axes, voxel), voxel, volume, lost)


def _spread(
    where: NDArray[np.float64], vectors: NDArray[np.float64], shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """A vector field (3, X, Y, Z): each vector shared among the corners of its voxel, blurred."""
    field = np.zeros((3, *shape))
    base = np.floor(where).astype(np.intp)
    part = where - base
    for corner in np.ndindex(2, 2, 2):
        offset = np.array(corner)[:, None]
        weight = np.where(offset, part, 1.0 - part).prod(axis=0)
        for k in range(3):
            np.add.at(field[k], tuple(base + offset), weight * vectors[:, k])
    return np.stack([ndimage.gaussian_filter(each, SPREAD) for each in field])


def _divergence(field: NDArray[np.float64]) -> NDArray[np.float64]:
    return sum(np.gradient(field[k], axis=k) for k in range(3))  # type: ignore[return-value]


def _poisson(source: NDArray[np.float64]) -> NDArray[np.float64]:
    """The function whose Laplacian (seven points, voxel 1) is the source; zero beyond the grid."""
    waves = [np.arange(1, n + 1) * np.pi / (n + 1) for n in source.shape]
    symbols = [2.0 * np.cos(wave) - 2.0 for wave in waves]
    laplacian = symbols[0][:, None, None] + symbols[1][None, :, None] + symbols[2][None, None, :]
    return fft.idstn(fft.dstn(source, type=1) / laplacian, type=1)
