"""One step of a fit: handles that bring every row closer to its goal."""

import torch
from torch import Tensor

from codesign_design.base_mesh import UNIT_LENGTH
from codesign_design.matching import Rows

_DAMPING = 1e-5
_ADAM_RATE = 0.02  # units


def distances(rows: Rows, handles: Tensor) -> Tensor:
    """(B, R) how far each row is from its goal; 0.3 of the way along the surface counts."""
    offsets = rows.weights @ handles - rows.goals
    along = (offsets * rows.directions).sum(-1)
    return (along.square() + 0.1 * offsets.square().sum(-1)).sqrt()


def solve(rows: Rows, handles: Tensor, nearest: float = 0.3e-3, sliding: float = 0.8) -> Tensor:
    """Handles that minimise the rows' weighted squares, each weighted by 1 / its distance now.

    Args:
        nearest: distances below this count as this [m].
        sliding: how freely points move across their row's direction, 0 to 1.
    """
    batch, count, n = rows.weights.shape
    distance = distances(rows, handles)
    importance = rows.importance / distance.clamp_min(nearest / UNIT_LENGTH)
    weighted = rows.weights * importance[..., None]
    offsets = rows.weights @ handles - rows.goals
    jacobian = (rows.weights[..., None] * rows.directions[:, :, None]).reshape(batch, count, 3 * n)
    along = (offsets * rows.directions).sum(-1)
    matrix = jacobian.transpose(1, 2) @ (jacobian * importance[..., None])
    slope = (jacobian * (importance * along)[..., None]).sum(1)
    whole = torch.kron((rows.weights.transpose(1, 2) @ weighted).contiguous(), torch.eye(3)[None])
    matrix = sliding * matrix + (1.0 - sliding) * whole
    slope = sliding * slope + (1.0 - sliding) * (weighted.transpose(1, 2) @ offsets).flatten(1)
    damping = _DAMPING * importance.sum(1)[:, None, None] * torch.eye(3 * n, dtype=torch.float64)
    return handles - torch.linalg.solve(matrix + damping, slope).reshape(batch, n, 3)


class Adam:
    """The same step by gradient: Adam on the mean distance of the rows."""

    def __init__(self, handles: Tensor) -> None:
        self.handles = handles.clone().requires_grad_()
        self.optimizer = torch.optim.Adam([self.handles], lr=_ADAM_RATE)

    def __call__(self, rows: Rows, handles: Tensor) -> Tensor:
        with torch.no_grad():
            self.handles.copy_(handles)
        self.optimizer.zero_grad()
        (distances(rows, self.handles) * rows.importance).mean(1).sum().backward()
        self.optimizer.step()
        return self.handles.detach()
