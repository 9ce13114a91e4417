"""Rows of the fitting problem: which point of the finger should be where.

A row is a point on the finger, given by its weights w over the handles, a goal g and a direction
n. Its position is w H, linear in the handles H, so every term of the fit (two-way Chamfer, wall
thickness, closing) is a set of rows. Batched over restarts, float64, unit space.
"""

from dataclasses import dataclass

import igl
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_FACES_PER_DRAW = 1200  # a fresh random subset of faces stands for the surface in each iteration


@dataclass(frozen=True)
class Rows:
    """weights (B, R, N), goals (B, R, 3), unit directions (B, R, 3), importance (B, R)."""

    weights: Tensor
    goals: Tensor
    directions: Tensor
    importance: Tensor

    @staticmethod
    def joined(parts: list["Rows"]) -> "Rows":
        """All rows of the parts."""
        return Rows(
            *(
                torch.cat([getattr(part, name) for part in parts], dim=1)
                for name in ("weights", "goals", "directions", "importance")
            )
        )


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

    def sample(self, handles: Tensor, count: int, random: torch.Generator) -> Samples:
        """Fresh points, uniform over each of the (B, N, 3) deformed surfaces."""
        chosen = torch.randperm(len(self.faces), generator=random)[:_FACES_PER_DRAW]
        corner_weights = self.weights[self.faces[chosen]]  # (F, 3, N)
        a, b, c = (corner_weights @ handles[:, None]).unbind(2)
        normals = torch.linalg.cross(b - a, c - a)
        areas = normals.norm(dim=-1)
        face = torch.multinomial(areas, count, replacement=True, generator=random)
        u = torch.rand(2, *face.shape, generator=random, dtype=torch.float64)
        root = u[0].sqrt()
        inside = torch.stack([1.0 - root, root * (1.0 - u[1]), root * u[1]], dim=-1)
        weights = (inside[..., None] * corner_weights[face]).sum(2)
        unit = normals / areas.clamp_min(1e-12)[..., None]
        return Samples(weights, weights @ handles, _picked(unit, face))

    def nearest(self, handles: Tensor, points: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
        """Weights (P, N) of the surface points nearest to (P, 3), and those points (P, 3)."""
        vertices = (self.weights @ handles).numpy()
        faces = self.faces.numpy()
        _, index, nearest = igl.point_mesh_squared_distance(points, vertices, faces)
        a, b, c = (np.ascontiguousarray(vertices[faces[index, k]]) for k in range(3))
        inside = torch.from_numpy(igl.barycentric_coordinates(nearest, a, b, c))
        inside = torch.nan_to_num(inside, nan=1.0 / 3.0)  # a face squeezed to a line or a point
        weights = (inside[..., None] * self.weights[self.faces[index]]).sum(1)
        return weights, weights @ handles


def chamfer_rows(finger: Samples, points: Tensor, normals: Tensor, normal_weight: float) -> Rows:
    """Each finger sample to its nearest target point, and each target point's nearest to it.

    Nearest in position and, times `normal_weight`, in normal, so that the two faces of a thin
    plate are not taken for each other.

    Args:
        points, normals: (T, 3) samples of the target.
    """
    batch = len(finger.points)
    ours = torch.cat([finger.points, normal_weight * finger.normals], dim=-1).float()
    theirs = torch.cat([points, normal_weight * normals], dim=-1).float()
    squared = (theirs**2).sum(-1) - 2.0 * ours @ theirs.T
    to_target = squared.argmin(dim=2)
    to_finger = (squared + (ours**2).sum(-1)[..., None]).argmin(dim=1)
    forward = Rows(finger.weights, points[to_target], normals[to_target], _ones(finger.points))
    goals = points.expand(batch, -1, -1)
    backward = Rows(
        _picked(finger.weights, to_finger), goals, normals.expand(batch, -1, -1), _ones(goals)
    )
    return Rows.joined([forward, backward])


def wall_rows(finger: Samples, thickness: float, importance: float) -> Rows:
    """Pairs of opposite surface points closer than `thickness` should be that far apart."""
    count = finger.points.shape[1] // 2
    first, second = (
        Samples(*(value[:, part] for value in (finger.weights, finger.points, finger.normals)))
        for part in (slice(0, count), slice(count, 2 * count))
    )
    offsets = first.points[:, :, None] - second.points[:, None]  # (B, S, S, 3)
    along = torch.einsum("bijk,bik->bij", offsets, first.normals)
    facing = torch.einsum("bik,bjk->bij", first.normals, second.normals) < -0.5
    across = (offsets.square().sum(-1) - along.square()).clamp_min(0.0)
    partner = torch.where(facing & (along > -thickness), across, torch.inf).min(dim=2)
    weights = first.weights - _picked(second.weights, partner.indices)
    gap = torch.gather(along, 2, partner.indices[..., None])[..., 0]
    thin = (partner.values < thickness**2) & (gap < thickness)
    return Rows(weights, thickness * first.normals, first.normals, importance * thin.double())


def closing_rows(finger: Samples, plane: float, importance: float) -> Rows:
    """Points beyond the closing plane y = `plane`, where the other finger is, should be on it."""
    goals = finger.points.clone()
    goals[..., 1] = plane
    along = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(goals)
    beyond = (finger.points[..., 1] < plane).double()
    return Rows(finger.weights, goals, along, importance * beyond)


def _picked(values: Tensor, index: Tensor) -> Tensor:
    """Rows `index` (B, K) of values (B, S, D)."""
    return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))


def _ones(points: Tensor) -> Tensor:
    return torch.ones(points.shape[:2], dtype=torch.float64)
