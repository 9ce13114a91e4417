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
        for environment, pair in zip(environments, pairs, strict=True):
            self._grids[environment] = tuple(bake(mesh) for mesh in pair or ())
            self.closing_limits[environment] = closing_limit(*pair) if pair else 0.0
            self.radii[environment] = max((mesh.radius for mesh in pair or ()), default=0.0)
        self._warn_of_thin_walls(environments)
        self._upload([grid for e in environments for grid in self._grids[e]])
        for environment, grids in enumerate(self._grids):
            self._describe(environment, grids)
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

    def _upload(self, grids: list[DistanceGrid]) -> None:
        """Puts grids that are not in the pool behind the others, or all into a larger pool."""
        new = {grid: None for grid in grids if grid not in self._offsets}
        size = 2 * sum(grid.values.size for grid in new)
        if self._end + size > self._scene.grids.size:
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

    def _clear_anchors(self, environments: np.ndarray) -> None:
        anchors, layout = self._scene.anchors.numpy(), self._layout
        by_lane = anchors.reshape(layout.groups, _OBSTACLES, -1, layout.lanes)
        by_lane[environments // layout.lanes, :2, :, environments % layout.lanes] = 0
        self._scene.anchors.assign(anchors)

    def _warn_of_thin_walls(self, environments: np.ndarray) -> None:
        for environment in environments:
            for name, grid in zip(("left", "right"), self._grids[environment], strict=False):
                if grid.thin_area > _THIN_AREA:
                    place = ", ".join(f"{v * 1e3:.1f}" for v in np.asarray(grid.thin_place))
                    warnings.warn(
                        f"{name} finger has {grid.thin_area * 1e6:.0f} mm^2 of walls thinner than "
                        f"{THINNEST * 1e3:g} mm (thinnest {grid.thinnest * 1e3:.2f} mm, at "
                        f"{place} mm): the block may pass through them; make them thicker",
                        stacklevel=4,
                    )

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
