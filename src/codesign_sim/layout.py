"""How arrays lie in memory: [group][item][component][lane], explained in native/lanes.h."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from codesign_sim import kernels
from codesign_sim.soft_object import SoftObject

_ROW = 4  # floats of a node's row: x, y, z and padding


class Layout:
    """Lanes, groups and the order of items for a block in a number of environments.

    Attributes:
        mode: what the kernels are compiled for, see kernels.py.
        device: where the arrays are.
        lanes: environments in a group.
        groups: the units of a kernel's launch.
        width: floats side by side in an item's state.
        tets, triangles, nodes: (vectors, lanes with an item of their own) item numbers, -1 where
            a lane has none.
    """

    def __init__(self, block: SoftObject, environments: int, device: str = "cpu") -> None:
        self.block = block
        self.environments = environments
        self.device = kernels.find_device(device)
        self.mode = kernels.mode_for(environments, self.device)
        self.lanes = max(self.mode, 1)
        self.groups = -(-environments // self.lanes)
        copies = {1: kernels.ITEM_LANES, kernels.TEAM: kernels.TEAM_LANES}.get(self.mode, 1)
        self.width = max(copies, self.lanes)
        # Vectors follow one another; a team's threads take neighbours at the same time.
        arrange = _packed if self.mode == kernels.TEAM else _spread
        self.tets = arrange(len(block.tetrahedra), copies)
        self.triangles = _packed(len(block.surface_triangles), copies)
        self.nodes = _packed(len(block.nodes), copies)
        # Lanes beyond the last node get rows of their own, so that no two lanes share one.
        self._node_order = np.where(
            self.nodes < 0, len(block.nodes) + np.arange(copies), self.nodes
        )
        self.rows = int(self._node_order.max()) + 1
        self._views: dict[int, np.ndarray] = {}

    def describe_block(self, scene: Any) -> None:
        """Puts sizes, topology and rest shape of the block into a scene."""
        block = self.block
        scene.threads = kernels.threads(self.device)
        scene.groups, scene.node_rows = self.groups, self.rows
        scene.tet_items, scene.triangle_items = len(self.tets), len(self.triangles)
        scene.node_items = len(self.nodes)
        triangular = _triangular(block.inverse_edges)
        shapes = _items(np.column_stack([triangular, block.volumes]), self.tets)
        shapes[:, 6][self.tets < 0] = 0  # a repeated tetrahedron fills the vector with no volume
        scene.tet_nodes = self.ints(_items(block.tetrahedra, self.tets))
        scene.tet_shapes = self.floats(shapes)
        scene.triangle_nodes = self.ints(_items(block.surface_triangles, self.triangles))
        areas = np.where(self.triangles < 0, 0, block.surface_areas[self.triangles])
        scene.triangle_areas = self.floats(areas)
        scene.node_order = self.ints(self._node_order)
        starts, corners = self._corners() if self.mode == kernels.TEAM else (np.zeros(1),) * 2
        scene.corner_starts, scene.corners = self.ints(starts), self.ints(corners)

    def allocate(self, scene: Any) -> None:
        """Puts zeroed state and result arrays into a scene."""
        lanes, groups, triangles = self.lanes, self.groups, len(self.triangles)
        for name in ("positions", "velocities", "ahead", "forces", "loads"):
            setattr(scene, name, self.zeros(groups * self.rows * _ROW * lanes))
        scene.anchors = self.zeros(groups * 3 * triangles * 3 * 4 * self.width)
        team = self.width if self.mode == kernels.TEAM else 0
        scene.near_obstacle = self.ints(np.zeros(groups * triangles * max(team, 1)))
        scene.corner_forces = self.zeros(groups * (12 * len(self.tets) + 9 * triangles) * team)
        scene.centres = self.zeros(groups * 3 * lanes)
        scene.materials = self.zeros(groups * 4 * lanes)
        scene.motions = self.zeros(groups * 18 * lanes)
        scene.reports = self.zeros(groups * 12 * lanes)
        scene.stresses = self.zeros(groups * len(self.tets) * 2 * self.width)

    def _corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the corner forces of every node lie, node by node, and where each node's begin."""
        places, nodes, base = [], [], 0
        for items, of in (
            (self.tets, self.block.tetrahedra),
            (self.triangles, self.block.surface_triangles),
        ):
            vectors, lanes = items.shape
            count = of.shape[1]
            place = np.arange(vectors)[:, None, None] * count * 3 + np.arange(count) * 3
            place = base + place * lanes + np.arange(lanes)[:, None]
            places.append(place[items >= 0].ravel())
            nodes.append(of[items[items >= 0]].ravel())
            base += items.size * count * 3
        node = np.concatenate(nodes)
        order = np.argsort(node, kind="stable")
        starts = np.searchsorted(node[order], np.arange(self.rows + 1))
        return starts, np.concatenate(places)[order]

    def node_constants(self, pinned: np.ndarray) -> wp.array:
        """Mass share, 1 / volume, freedom and gravity share of every node; see fem.h."""
        block = self.block
        free = np.where(pinned, 0.0, 1.0)
        constants = [
            block.node_volumes / block.volume,
            free / block.node_volumes,
            free,
            free * block.load_volumes / block.node_volumes,
        ]
        laid_out = _items(np.stack(constants, axis=1), self.nodes)
        return self.floats(np.where((self.nodes < 0)[:, None, :], 0, laid_out))

    def zeros(self, size: int) -> wp.array:
        """A zeroed float array."""
        return wp.zeros(size, dtype=wp.float32, device=self.device)

    def floats(self, values: np.ndarray) -> wp.array:
        """A flat float array of the values."""
        flat = np.ascontiguousarray(values, dtype=np.float32).ravel()
        return wp.array(flat, dtype=wp.float32, device=self.device)

    def ints(self, values: np.ndarray) -> wp.array:
        """A flat integer array of the values."""
        flat = np.ascontiguousarray(values, dtype=np.int32).ravel()
        return wp.array(flat, dtype=wp.int32, device=self.device)

    def grouped(self, values: np.ndarray) -> np.ndarray:
        """(E, ...) to [group][...][lane], flat; spare lanes repeat the last environment."""
        spare = self.groups * self.lanes - self.environments
        values = np.concatenate([values, np.repeat(values[-1:], spare, axis=0)])
        values = values.reshape(self.groups, self.lanes, *values.shape[1:])
        kind = np.int32 if values.dtype.kind == "i" else np.float32
        return np.ascontiguousarray(np.moveaxis(values, 1, -1), dtype=kind).ravel()

    def host(self, array: wp.array) -> np.ndarray:
        """Values of an array that lives as long as this: on the CPU a view, from CUDA a copy."""
        if self.device.is_cuda:
            return array.numpy()
        if array.ptr not in self._views:
            self._views[array.ptr] = array.numpy()
        return self._views[array.ptr]

    def write(self, array: wp.array, values: np.ndarray) -> None:
        """Writes all values, flat, of an array that lives as long as this."""
        if self.device.is_cuda:
            array.assign(values)
        else:
            self.host(array)[:] = values

    def ungrouped(self, array: wp.array, *shape: int) -> np.ndarray:
        """[group][shape][lane] back to (E, *shape), as a copy in double precision."""
        values = self.host(array).reshape(self.groups, *shape, self.lanes)
        values = np.moveaxis(values, -1, 1).astype(np.float64, order="C").reshape(-1, *shape)
        return values[: self.environments]

    def overwrite(self, array: wp.array, environments: np.ndarray, values: np.ndarray) -> None:
        """Writes (K, ...) values of K environments; every other one keeps its bits.

        Spare lanes follow the last environment.
        """
        host = self.host(array)
        lane = np.arange(self.groups * self.lanes)
        source = np.minimum(lane, self.environments - 1)  # the environment that a lane shows
        row = np.full(self.environments, -1)
        row[environments] = np.arange(len(environments))
        lane = lane[row[source] >= 0]
        flat = values.reshape(len(environments), -1)[row[source[lane]]]
        by_lane = host.reshape(self.groups, -1, self.lanes)
        by_lane[lane // self.lanes, :, lane % self.lanes] = flat
        if self.device.is_cuda:
            array.assign(host)

    def padded(self, values: np.ndarray) -> np.ndarray:
        """Node vectors (K, N, 3) as padded rows (K, rows, 4)."""
        rows = np.zeros((len(values), self.rows, _ROW))
        rows[:, : values.shape[1], :3] = values
        return rows

    def node_rows(self, values: np.ndarray) -> np.ndarray:
        """Node vectors (E, N, 3) as padded rows, flat."""
        return self.grouped(self.padded(values))

    def node_vectors(self, array: wp.array) -> np.ndarray:
        """Padded rows back to node vectors (E, N, 3)."""
        return self.ungrouped(array, self.rows, _ROW)[:, : len(self.block.nodes), :3]

    def per_tetrahedron(self, array: wp.array, measure: int) -> np.ndarray:
        """Stresses [group][tet item][2][lane] of one measure as (E, T)."""
        values = self.host(array).reshape(self.groups, len(self.tets), 2, self.width)[:, :, measure]
        if self.lanes == 1:
            result = np.empty((self.groups, len(self.block.tetrahedra)))
            used = self.tets >= 0
            result[:, self.tets[used]] = values[:, used]
        else:
            by_lane = np.moveaxis(values, -1, 1).astype(np.float64, order="C")
            result = by_lane.reshape(-1, len(self.tets))
        return result[: self.environments]


def _triangular(inverse_edges: np.ndarray) -> np.ndarray:
    """Rest shapes (T, 6) as native/elements.h has them, of inverse edge matrices (T, 3, 3)."""
    edges = np.linalg.qr(np.linalg.inv(inverse_edges), mode="r")
    signs = np.sign(np.diagonal(edges, axis1=1, axis2=2))  # a turn, not a mirror
    rows, columns = np.triu_indices(3)
    return -np.linalg.inv(signs[:, :, None] * edges)[:, rows, columns]


def _packed(count: int, copies: int) -> np.ndarray:
    """Items (vectors, copies) side by side; -1 where a lane has none."""
    padded = np.full(-(-count // copies) * copies, -1)
    padded[:count] = np.arange(count)
    return padded.reshape(-1, copies)


def _spread(count: int, copies: int) -> np.ndarray:
    """Like `_packed`, with the items of a vector far apart.

    Neighbouring tetrahedra add to the same nodes, and each addition would wait for the last.
    """
    return np.ascontiguousarray(_packed(count, copies).reshape(copies, -1).T)


def _items(values: np.ndarray, order: np.ndarray) -> np.ndarray:
    """(items, components) to [vector][component][lane]; lanes without an item repeat the first."""
    return np.moveaxis(values[np.maximum(order, 0)], 1, -1).copy()
