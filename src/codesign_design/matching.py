"""Rows of the fitting problem: which point of the finger should be where.

A row is a point on the finger, given by its weights w over the handles, a goal g and a direction
n. Its position is w H, linear in the handles H, so every term of the fit (two-way Chamfer, wall
thickness, closing) is a set of rows. Batched over restarts, float64, unit space.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from codesign_design.fit_surfaces import Samples, picked


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


def chamfer_rows(finger: Samples, points: Tensor, normals: Tensor, normal_weight: float) -> Rows:
    """Each finger sample to its nearest target point, and each target point's nearest to it.

    Nearest in position and, times `normal_weight`, in normal, so that the two faces of a thin
    plate are not taken for each other.

    Args:
        points, normals: (T, 3) samples of the target.
    """
    ours = torch.cat([finger.points, normal_weight * finger.normals], dim=-1).float()
    theirs = torch.cat([points, normal_weight * normals], dim=-1).float()
    theirs = theirs.expand(len(ours), -1, -1)
    to_target, to_finger = _nearest(ours, theirs), _nearest(theirs, ours)
    forward = Rows(finger.weights, points[to_target], normals[to_target], _ones(finger.points))
    goals = points.expand(len(ours), -1, -1)
    backward = Rows(
        picked(finger.weights, to_finger), goals, normals.expand_as(goals), _ones(goals)
    )
    return Rows.joined([forward, backward])


def nearest_rows(
    finger: Samples, goals: Tensor, points: Tensor, weights: Tensor, nearest: Tensor
) -> tuple[Rows, Tensor]:
    """Rows along the way to nearest points, and their mean lengths (B,).

    Args:
        goals: (B, S, 3) the target's nearest point to each finger sample.
        points: (T, 3) samples of the target.
        weights, nearest: (B, T, N) and (B, T, 3) of the finger's nearest point to each.
    """
    points = points.expand_as(nearest)
    offsets = torch.cat([finger.points - goals, nearest - points], dim=1)
    lengths = offsets.norm(dim=-1)
    rows = Rows(
        torch.cat([finger.weights, weights], dim=1),
        torch.cat([goals, points], dim=1),
        offsets / lengths.clamp_min(1e-9)[..., None],
        _ones(offsets),
    )
    return rows, lengths.mean(1)


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
    weights = first.weights - picked(second.weights, partner.indices)
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


def _nearest(ours: Tensor, theirs: Tensor) -> Tensor:
    """(B, S) index of the nearest of (B, T, D) to each of (B, S, D).

    One product gives |t|^2 - 2 o t; NumPy finds its least four times as fast as torch does.
    """
    ones = torch.ones_like(ours[..., :1])
    lifted = torch.cat([-2.0 * theirs, theirs.square().sum(-1, keepdim=True)], dim=-1)
    squared = torch.cat([ours, ones], dim=-1) @ lifted.transpose(1, 2)
    return torch.from_numpy(squared.numpy().argmin(-1))


def _ones(points: Tensor) -> Tensor:
    return torch.ones(points.shape[:2], dtype=torch.float64)
