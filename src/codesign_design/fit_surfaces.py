"""The two surfaces of a fit: the finger's, linear in its handles, and the target's.

Both can be sampled afresh and asked for nearest points. Float64, unit space, batched over the B
fingers of a search.
"""

from dataclasses import dataclass

import igl
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from trimesh.triangles import closest_point

from codesign_design.finger_pair import TriangleMesh

_FACES_PER_DRAW = 1200  # a fresh random subset of faces stands for the finger in each iteration


@dataclass(frozen=True)
class Samples:
    """Points on B deformed surfaces: weights (B, S, N), points and normals (B, S, 3)."""

    weights: Tensor
    points: Tensor
    normals: Tensor


class Surface:
    """The base mesh as fitting sees it: weights of its vertices, and its faces."""

    def __init__(self, weights: Tensor, faces: NDArray[np.int32]) -> None:
        self.weights = weights
        self.faces = torch.from_numpy(faces.astype(np.int64))
        self._around = _faces_around_vertices(self.faces.numpy())

    def sample(self, handles: Tensor, count: int, random: torch.Generator) -> Samples:
        """Fresh points, uniform over each of the (B, N, 3) deformed surfaces."""
        chosen = torch.randperm(len(self.faces), generator=random)[:_FACES_PER_DRAW]
        corner_weights = self.weights[self.faces[chosen]]  # (F, 3, N)
        normals, areas = _normals_and_areas(*(corner_weights @ handles[:, None]).unbind(2))
        face = torch.multinomial(areas, count, replacement=True, generator=random)
        inside = _random_barycentric(face.shape, random)
        weights = (inside[..., None] * corner_weights[face]).sum(2)
        return Samples(weights, weights @ handles, picked(normals, face))

    def nearest(self, handles: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Surface points next to (P, 3): their weights (B, P, N) and themselves (B, P, 3).

        Each is the nearest point of the faces around the nearest vertex. For nine in ten that is
        the nearest of the whole surface, for the rest it is hardly further away; a hierarchy over
        all faces, new for every step of the handles, takes three times as long.
        """
        vertices = (self.weights @ handles).numpy()  # (B, V, 3)
        goals = np.broadcast_to(points.numpy(), (len(vertices), *points.shape))
        vertex = np.stack([_tree(v).query(p)[1] for v, p in zip(vertices, goals, strict=True)])
        faces = self._around[vertex]  # (B, P, K)
        which = np.arange(len(vertices))[:, None, None, None]
        corners = vertices[which, self.faces.numpy()[faces]]  # (B, P, K, 3, 3)
        repeated = np.repeat(goals[:, :, None], faces.shape[2], axis=2)
        found = closest_point(corners.reshape(-1, 3, 3), repeated.reshape(-1, 3))
        found = found.reshape(repeated.shape)
        best = ((found - repeated) ** 2).sum(-1).argmin(-1)
        b, p = np.indices(best.shape)
        inside = _barycentric(found[b, p, best], corners[b, p, best])
        weights = (inside[..., None] * self.weights[self.faces[faces[b, p, best]]]).sum(2)
        return weights, weights @ handles


class Target:
    """A fixed surface."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._mesh = mesh.vertices, mesh.faces.astype(np.int64)
        self._tree = igl.AABB()
        self._tree.init(*self._mesh)
        self._corners = torch.from_numpy(mesh.vertices[mesh.faces])
        self._normals, self._areas = _normals_and_areas(*self._corners.unbind(1))

    def sample(self, count: int, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Fresh points, uniform over the surface, and the normals there, both (count, 3)."""
        face = torch.multinomial(self._areas, count, replacement=True, generator=random)
        inside = _random_barycentric(face.shape, random)
        return (inside[..., None] * self._corners[face]).sum(1), self._normals[face]

    def nearest(self, points: Tensor) -> Tensor:
        """The surface's nearest point to each of (B, P, 3)."""
        _, _, found = self._tree.squared_distance(*self._mesh, points.reshape(-1, 3).numpy())
        return torch.from_numpy(found).reshape(points.shape)


def picked(values: Tensor, index: Tensor) -> Tensor:
    """Rows `index` (B, K) of values (B, S, D)."""
    return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))


def _normals_and_areas(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """Unit normals (..., 3) and areas (...) of triangles."""
    normals = torch.linalg.cross(b - a, c - a)
    doubled = normals.norm(dim=-1)
    return normals / doubled.clamp_min(1e-12)[..., None], doubled / 2.0


def _random_barycentric(shape: torch.Size, random: torch.Generator) -> Tensor:
    """(*shape, 3) coordinates of points spread evenly over a triangle."""
    u = torch.rand(2, *shape, generator=random, dtype=torch.float64)
    root = u[0].sqrt()
    return torch.stack([1.0 - root, root * (1.0 - u[1]), root * u[1]], dim=-1)


def _barycentric(points: NDArray[np.float64], corners: NDArray[np.float64]) -> Tensor:
    """(B, P, 3) coordinates of points in triangles (B, P, 3, 3).

    A triangle squeezed to a line or a point has none: its middle is taken.
    """
    a, b, c = (np.ascontiguousarray(corners[..., k, :]).reshape(-1, 3) for k in range(3))
    inside = igl.barycentric_coordinates(points.reshape(-1, 3), a, b, c)
    return torch.nan_to_num(torch.from_numpy(inside), nan=1.0 / 3.0).reshape(points.shape)


def _tree(points: NDArray[np.float64]) -> cKDTree:
    """Quick to build rather than to ask: it is asked once."""
    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def _faces_around_vertices(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """(V, K) the faces that meet in each vertex, the last one repeated where there are fewer."""
    order = np.argsort(faces.ravel(), kind="stable") // 3
    count = np.bincount(faces.ravel())
    last = np.cumsum(count) - 1
    return order[np.minimum((last - count + 1)[:, None] + np.arange(count.max()), last[:, None])]
