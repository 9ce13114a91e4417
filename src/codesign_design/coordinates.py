"""Mean value coordinates of points with respect to a closed triangle cage.

Ju, Schaefer and Warren 2005, in the vector form of Floater, Kós and Reimers 2005. With the weights
W of fixed points in a fixed rest cage, moving the cage's handles H moves the points to W H: linear
in the handles, and exact for affine motions.
"""

import torch
from torch import Tensor

ON_CAGE = 1e-9  # distance to the cage, relative to its size, below which a point lies on it


def mean_value_coordinates(points: Tensor, handles: Tensor, faces: Tensor) -> Tensor:
    """Weights of each handle at each point; every row sums to one.

    Args:
        points: (..., P, 3) float64, inside the cage or on it.
        handles: (N, 3) float64 cage vertices.
        faces: (F, 3) int64 triangles of the closed cage, counter-clockwise seen from outside.

    Returns:
        (..., P, N) float64.

    Raises:
        ValueError: not float64, or wrong shapes.
    """
    for name, value in (("points", points), ("handles", handles)):
        if value.dtype != torch.float64 or value.shape[-1] != 3:
            raise ValueError(
                f"{name} are {value.dtype} of shape {tuple(value.shape)}; "
                "pass float64 with 3 numbers in the last dimension"
            )
    flat = points.reshape(-1, 3)
    size = (handles.max(0).values - handles.min(0).values).max()
    weights = _inside(flat, handles, faces)
    weights = _on_faces(flat, handles, faces, weights, size * ON_CAGE)
    return weights.reshape(*points.shape[:-1], len(handles))


def _inside(points: Tensor, handles: Tensor, faces: Tensor) -> Tensor:
    """The general formula; rows of points that lie on the cage are meaningless here."""
    tiny = torch.finfo(torch.float64).tiny
    offsets = handles - points[:, None]
    distances = offsets.norm(dim=-1)
    units = offsets / distances.clamp_min(tiny)[..., None]
    corner = units[:, faces]  # (P, F, 3 corners, 3)
    opposite = corner.roll(-1, 2), corner.roll(-2, 2)  # the two ends of the edge facing a corner
    cross = torch.linalg.cross(*opposite)
    sine = cross.norm(dim=-1)
    angle = torch.atan2(sine, (opposite[0] * opposite[1]).sum(-1))
    normal = cross / sine.clamp_min(tiny)[..., None]
    # mu_i = (b_jk + b_ij n_ij.n_jk + b_ki n_ki.n_jk) / (2 e_i.n_jk): all three angles with the
    # cosines between their normals, the one facing the corner itself with cosine 1.
    cosines = normal @ normal.transpose(-1, -2)
    height = (corner * normal).sum(-1)
    mu = (cosines * angle[:, :, None, :]).sum(-1) / (2.0 * height)
    # A point in the plane of a triangle but outside it: the triangle subtends no angle.
    flat = height.abs().amin(-1, keepdim=True) < ON_CAGE
    mu = torch.where(flat, torch.zeros_like(mu), mu)
    weights = torch.zeros_like(distances)
    weights.index_add_(1, faces.reshape(-1), mu.reshape(len(points), -1))
    weights = weights / distances.clamp_min(tiny)
    return weights / weights.sum(-1, keepdim=True)


def _on_faces(
    points: Tensor, handles: Tensor, faces: Tensor, weights: Tensor, near: Tensor
) -> Tensor:
    """Replaces the rows of points that lie on a face by their barycentric coordinates there."""
    weights = weights.clone()
    for face in faces:
        a, b, c = handles[face]
        normal = torch.linalg.cross(b - a, c - a)
        area = normal.norm()
        heights = (points - a) @ normal / area
        barycentric = torch.stack(
            [
                torch.linalg.cross((q - p).expand_as(points), points - p) @ normal / area**2
                for p, q in ((b, c), (c, a), (a, b))
            ],
            dim=-1,
        )
        slack = near / area.sqrt()
        on = (heights.abs() < near) & (barycentric >= -slack).all(-1)
        weights[on] = 0.0
        weights[on.nonzero(), face] = barycentric[on]
    return weights
