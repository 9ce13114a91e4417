"""The fingers of every environment, as the kernels see them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from codesign_sim.closing import closing_limit
from codesign_sim.distance import THINNEST, DistanceGrid, bake
from codesign_sim.layout import Layout
from codesign_sim.mesh import SurfaceMesh

Fingers = tuple[SurfaceMesh, SurfaceMesh]

_FRAME, _INDEX = 8, 3  # values per finger, as GRID and GRID_INDEX in native/contact.h
_OBSTACLES = 3  # left finger, right finger, table
_THIN_AREA = 2e-6  # m^2 of thin walls that are worth a warning


class FingerBank:
    """Distance grids in one pool, each shape once, and where each environment's two lie in it.

    Attributes:
        closing_limits: (E,) smallest width in metres, 0 where there are no fingers.
        radii: (E,) largest distance of a finger's vertex from the grasp frame's origin, metres.
    """

    def __init__(self, scene: Any, layout: Layout, device: str) -> None:
        self._scene, self._layout = scene, layout
        count = layout.environments
        self.closing_limits = np.zeros(count)
        self.radii = np.zeros(count)
        self._frames = np.zeros((count, 2, _FRAME))
        self._frames[..., 3] = 1.0  # cells per metre; no cells, so nothing is inside
        self._indices = np.zeros((count, 2, _INDEX), dtype=int)
        self._grids: list[tuple[DistanceGrid, ...]] = [()] * count
        self._offsets: dict[DistanceGrid, int] = {}
        self._end = 0
        scene.grids = wp.ones(8, dtype=wp.float32, device=device)
        scene.grid_frames = wp.zeros(self._frames_flat.size, dtype=wp.float32, device=device)
        scene.grid_indices = wp.zeros(self._indices_flat.size, dtype=wp.int32, device=device)

    def __bool__(self) -> bool:
        """Whether there are fingers anywhere."""
        return any(self._grids)

    def load(self, environments: np.ndarray, pairs: Sequence[Fingers | None]) -> None:
        """Gives K environments new pairs, None for no fingers; the others keep every bit.

        Clears the friction anchors on the fingers of the K.
        """
        # A mesh that cannot be baked must leave everything as it was.
        grids = [tuple(bake(mesh) for mesh in pair or ()) for pair in pairs]
        self.closing_limits[environments] = [closing_limit(*pair) if pair else 0 for pair in pairs]
        self.radii[environments] = [
            max((m.radius for m in pair or ()), default=0) for pair in pairs
        ]
        for environment, own in zip(environments, grids, strict=True):
            self._grids[environment] = own
        _warn_of_thin_walls(grids)
        moved = self._upload([grid for own in grids for grid in own])
        for environment in range(len(self._grids)) if moved else environments:
            self._describe(environment, self._grids[environment])
        self._scene.grid_frames.assign(self._frames_flat)
        self._scene.grid_indices.assign(self._indices_flat)
        self._clear_anchors(environments)

    def _describe(self, environment: int, grids: tuple[DistanceGrid, ...]) -> None:
        self._frames[environment, :, 4:7] = 0
        for side, grid in enumerate(grids):
            nz, ny, nx = grid.values.shape
            self._frames[environment, side, :7] = [
                *(*grid.origin, 1 / grid.spacing),
                *(nx - 1, ny - 1, nz - 1),
            ]
            self._indices[environment, side] = [self._offsets[grid], nx, nx * ny]

    def _upload(self, grids: list[DistanceGrid]) -> bool:
        """Puts grids that are not in the pool behind the others, or all into a larger pool.

        Returns whether grids that were there before have moved.
        """
        new = {grid: None for grid in grids if grid not in self._offsets}
        size = 2 * sum(grid.values.size for grid in new)
        full = self._end + size > self._scene.grids.size
        if full:
            new = {grid: None for grids in self._grids for grid in grids}
            size = 2 * sum(grid.values.size for grid in new)
            self._offsets, self._end = {}, 0
            device = self._scene.grids.device
            self._scene.grids = wp.zeros(2 * size, dtype=wp.float32, device=device)
        for grid in new:
            flat: wp.array = wp.array(_with_neighbours(grid), dtype=wp.float32, device="cpu")
            wp.copy(self._scene.grids, flat, dest_offset=self._end)
            self._offsets[grid] = self._end
            self._end += flat.size
        return full

    def _clear_anchors(self, environments: np.ndarray) -> None:
        anchors, layout = self._scene.anchors.numpy(), self._layout
        by_lane = anchors.reshape(layout.groups, _OBSTACLES, -1, layout.lanes)
        by_lane[environments // layout.lanes, :2, :, environments % layout.lanes] = 0
        self._scene.anchors.assign(anchors)

    @property
    def _frames_flat(self) -> np.ndarray:
        return self._layout.grouped(self._frames)

    @property
    def _indices_flat(self) -> np.ndarray:
        return self._layout.grouped(self._indices)


def _with_neighbours(grid: DistanceGrid) -> np.ndarray:
    """Each distance followed by its neighbour's along y, flat: what one load of a kernel takes."""
    values = grid.values
    beyond = np.concatenate([values[:, 1:], values[:, -1:]], axis=1)
    return np.stack([values, beyond], axis=-1).ravel()


def _warn_of_thin_walls(pairs: Sequence[tuple[DistanceGrid, ...]]) -> None:
    sides = (zip(("left", "right"), pair, strict=False) for pair in pairs)
    for name, grid in dict.fromkeys(one for side in sides for one in side):
        if grid.thin_area > _THIN_AREA:
            place = ", ".join(f"{v * 1e3:.1f}" for v in np.asarray(grid.thin_place))
            warnings.warn(
                f"{name} finger has {grid.thin_area * 1e6:.0f} mm^2 of walls thinner than "
                f"{THINNEST * 1e3:g} mm (thinnest {grid.thinnest * 1e3:.2f} mm, at {place} mm): "
                "the block may pass through them; make them thicker",
                stacklevel=4,
            )
