"""Penalty contact with anchored friction, for the implicit reference solver.

The same law as the simulator's: a pressure of 9 MPa per metre of depth at three points of every
surface triangle, and a spring of the same stiffness along the surface that slides at mu times the
pressure. Depths come from the formula of a box, or from that formula sampled on a lattice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

STIFFNESS = 9e6  # Pa of contact pressure per metre of depth
# Barycentric coordinates of a triangle's three quadrature points.
POINTS = np.array([[4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6


@dataclass(frozen=True, eq=False)
class Box:
    """A finger: a box of half edges `half` (3,) in m around its own origin, sharp edges."""

    half: np.ndarray

    def depth(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth below the nearest face, positive inside, and its normal: (M,), (M, 3)."""
        outside = np.abs(points) - self.half
        face = outside.argmax(axis=1)
        return -outside.max(axis=1), np.eye(3)[face] * np.sign(points)


@dataclass(frozen=True, eq=False)
class SampledBox(Box):
    """The same box by signed distances at lattice points 1 mm apart, linear in between."""

    spacing: float = 1e-3

    @cached_property
    def lattice(self) -> np.ndarray:
        """Signed distances, negative inside, (nx, ny, nz); the box starts two cells in."""
        count = np.round(2 * self.half / self.spacing).astype(int) + 5
        axes = [h - self.spacing * (n - 3 - np.arange(n)) for h, n in zip(self.half, count,
                                                                         strict=True)]  # fmt: skip
        beyond = np.abs(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)) - self.half
        out = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
        return out + np.minimum(beyond.max(axis=-1), 0)

    def depth(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        depth, normal = np.full(len(points), -1.0), np.zeros((len(points), 3))
        u = (points + self.half) / self.spacing + 2
        inside = ((u >= 0) & (u < np.array(self.lattice.shape) - 1)).all(axis=1)
        depth[inside], normal[inside] = self._interpolated(u[inside])
        return depth, normal

    def _interpolated(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cell, part = u.astype(int), u % 1
        value, slope = np.zeros(len(u)), np.zeros((len(u), 3))
        for corner in np.ndindex(2, 2, 2):
            x, y, z = np.where(corner, part, 1 - part).T
            at = self.lattice[tuple((cell + corner).T)]
            value += x * y * z * at
            sign = 2 * np.array(corner) - 1
            slope += sign * np.column_stack([y * z, x * z, x * y]) * at[:, None]
        return -value, slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)


class Table:
    """The half space below z = 0."""

    def depth(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return -points[:, 2], np.tile([0.0, 0.0, 1.0], (len(points), 1))


@dataclass(frozen=True, eq=False)
class Touch:
    """Contact at one trial state: touching points, their forces (N), minus the derivative of
    these by the points' positions (N/m), and where the points would be anchored (m)."""

    on: np.ndarray
    force: np.ndarray
    tangent: np.ndarray
    anchors: np.ndarray


class Contact:
    """Contact of a block's surface with one obstacle.

    Args:
        obstacle: its shape.
        origin: (3,) its place in the world, m; shift it by `origin +=`, it does not turn.
        triangles, nodes: surface (S, 3) and rest positions (N, 3), m.
        friction: Coulomb coefficient.
    """

    def __init__(self, obstacle, origin, triangles, nodes, friction: float) -> None:
        corner = nodes[triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        points = 3 * len(triangles)
        self.obstacle, self.origin = obstacle, np.array(origin, dtype=float)
        self.friction = friction
        self.stiffness = STIFFNESS * np.repeat(np.linalg.norm(normal, axis=1) / 6, 3)
        rows, columns = np.repeat(np.arange(points), 3), np.repeat(triangles, 3, axis=0).ravel()
        weights = np.tile(POINTS, (len(triangles), 1)).ravel()
        self.at = sparse.csr_matrix((weights, (rows, columns)), shape=(points, len(nodes)))
        self.spread = sparse.kron(self.at, np.eye(3), format="csr")
        self.anchors = np.full((points, 3), np.nan)  # seen from the origin; nan: not touching

    def touch(self, x: np.ndarray) -> Touch:
        """Forces on the points when the nodes are at x (N, 3), anchors as they are."""
        points = self.at @ x - self.origin
        depth, normal = self.obstacle.depth(points)
        on = np.flatnonzero(depth > 0)
        depth, normal, points = depth[on], normal[on], points[on]
        new = np.isnan(self.anchors[on, :1])  # sticks from the end of this step on
        stretch = np.where(new, 0.0, points - self.anchors[on])
        slip = stretch - (stretch * normal).sum(axis=1, keepdims=True) * normal
        length = np.maximum(np.linalg.norm(slip, axis=1), 1e-15)
        limit = self.friction * depth
        hold = np.minimum(1.0, limit / length)[:, None] * slip

        across = normal[:, :, None] * normal[:, None, :]
        along = np.eye(3) - across
        way = (slip / length[:, None])[:, :, None]
        # Sliding, the drag turns with the slip and grows with the depth; sticking, it is a spring.
        turning = (limit / length)[:, None, None] * (along - way * way.transpose(0, 2, 1))
        sliding = turning - self.friction * way * normal[:, None, :]
        sticking = np.where(new[:, :, None], 0.0, along)
        tangent = across + np.where((length > limit)[:, None, None], sliding, sticking)
        stiffness = self.stiffness[on]
        return Touch(
            on,
            stiffness[:, None] * (depth[:, None] * normal - hold),
            stiffness[:, None, None] * tangent,
            points - hold,
        )

    def node_forces(self, touch: Touch) -> np.ndarray:
        """Forces on the nodes (N, 3)."""
        return self.at[touch.on].T @ touch.force

    def node_stiffness(self, touch: Touch) -> sparse.csr_matrix:
        """Minus the derivative of the node forces by the nodes, (3N, 3N)."""
        rows = self.spread[(3 * touch.on[:, None] + np.arange(3)).ravel()]
        count = len(touch.on)
        blocks = sparse.bsr_matrix(
            (touch.tangent, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
        )
        return rows.T @ blocks @ rows

    def keep(self, touch: Touch) -> None:
        """Takes over the anchors at the end of a step."""
        self.anchors[:] = np.nan
        self.anchors[touch.on] = touch.anchors
