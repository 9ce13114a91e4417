"""Inverse design: the parameters whose finger comes closest to a target (paper Algorithm 1).

Many restarts run as one batch. "adam" is the paper's: gradient descent on the two-way Chamfer
distance of freshly sampled surfaces. "icp" alternates closest points with a closed-form solve for
all handles, reweighted so that it lowers the mean distance and not the mean square. Restarts that
fall behind are dropped on the way; the rest are polished against the exact surfaces, all briefly
and the last few to the end.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import igl
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from codesign_design.base_mesh import UNIT_LENGTH
from codesign_design.chamfer import chamfer_distance, distances_to, sample_surface, volume_iou
from codesign_design.design_space import CENTRE, DesignSpace
from codesign_design.finger_pair import TriangleMesh
from codesign_design.matching import Rows, Samples, Surface, chamfer_rows, closing_rows, wall_rows

_WITHIN = 0.75  # share of the bounds that a fit may use
_POLISH_SAMPLES = 600
_BRIEF = 12  # polishing iterations of those that are left, before the last choice
_EMPHASIS = 4.0  # what target points within the region count for
_AVERAGED = 10
_DAMPING = 1e-5
_ADAM_RATE = 0.02  # units

Progress = Callable[[float], None]
"""Called with the share of the work that is done, 0 to 1."""


@dataclass(frozen=True)
class FitOptions:
    """How to search.

    Attributes:
        method: "icp" or "adam".
        restarts: starting points.
        iterations: at most, before polishing; all restarts in the first third, the better third
            of them after that.
        samples: per surface and iteration.
        polished: restarts that are polished at the end; the better third briefly before.
        polish_iterations: at most, each.
        patience: stop polishing after this many iterations without an improvement of 0.1 %.
        normal_weight: distance that a reversed normal counts for, halved [m].
        wall: smallest wall thickness to ask for [m]; 0 asks for none.
        closing: ask that nothing protrudes beyond y = 0, where the other finger is.
        seed: equal seeds give equal fits.
    """

    method: str = "icp"
    restarts: int = 64
    iterations: int = 36
    samples: int = 250
    polished: int = 4
    polish_iterations: int = 60
    patience: int = 12
    normal_weight: float = 0.004
    wall: float = 0.0
    closing: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises ValueError: a count below one, a negative length, or an unknown method."""
        if self.method not in ("icp", "adam"):
            raise ValueError(f"method {self.method!r}: choose icp or adam")
        for name in ("restarts", "iterations", "samples", "polished", "polish_iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("normal_weight", "wall"):
            if not 0.0 <= getattr(self, name) < 0.05:
                raise ValueError(f"{name} is {getattr(self, name)} m; it must be within [0, 0.05)")


@dataclass(frozen=True)
class Fit:
    """The best finger found.

    Attributes:
        space: name of the design space.
        parameters: (3N,) design parameters.
        surface: fitted surface where the target is; not moved along y as `DesignSpace.surface`.
        chamfer: `chamfer_distance` to the target [m].
        iou: intersection over union of the volumes.
        region_iou: the same within the region asked for, or None.
        seconds: wall time.
        curve: (iterations,) best Chamfer estimate [m] in every iteration.
        others: (polished,) Chamfer distance of each polished restart [m].
    """

    space: str
    parameters: NDArray[np.float64]
    surface: TriangleMesh
    chamfer: float
    iou: float
    region_iou: float | None
    seconds: float
    curve: NDArray[np.float64] = field(repr=False)
    others: NDArray[np.float64] = field(repr=False)


def fit(
    space: DesignSpace,
    target: TriangleMesh,
    options: FitOptions | None = None,
    region: NDArray[np.float64] | None = None,
    progress: Progress = lambda share: None,
) -> Fit:
    """Finds parameters of `space` whose surface is like the target.

    Args:
        target: closed surface of a left finger in the grasp frame.
        region: (2, 3) corners of a box [m], e.g. around a lip. Distances to target points in it
            count four times; of the polished restarts, the one with the best overlap there is
            kept among those within 10 % of the best Chamfer.
        progress: told how far it is.

    Raises:
        ValueError: the target is not closed or too far away for the space's bounds.
    """
    started = time.perf_counter()
    options = options or FitOptions()
    problem = _Problem(space, target, options, region)
    handles, curve = problem.search(progress)
    brief = min(_BRIEF, options.polish_iterations)
    handles = torch.stack([problem.polish(start, brief)[0] for start in handles])
    progress(0.6)
    candidates = []
    for index, start in enumerate(problem.best(handles, options.polished)):
        best, tail = problem.polish(start, options.polish_iterations)
        candidates.append(best)
        curve = curve + tail if index == 0 else curve
        progress(0.6 + 0.35 * (index + 1) / options.polished)
    surfaces = [problem.surface(each) for each in candidates]
    chamfers = np.array([chamfer_distance(surface, target) for surface in surfaces])
    kept = int(chamfers.argmin())
    if region is not None:
        overlap = [volume_iou(surface, target, region=region) for surface in surfaces]
        near = chamfers <= 1.1 * chamfers.min()
        kept = int(np.where(near, overlap, -1.0).argmax())
    chosen = surfaces[kept]
    progress(1.0)
    return Fit(
        space.name,
        space.parameters_of(candidates[kept].numpy() * UNIT_LENGTH + CENTRE),
        chosen,
        float(chamfers[kept]),
        volume_iou(chosen, target),
        None if region is None else overlap[kept],
        time.perf_counter() - started,
        np.array(curve),
        chamfers,
    )


class _Problem:
    """One target in unit space, with what both methods share."""

    def __init__(
        self,
        space: DesignSpace,
        target: TriangleMesh,
        options: FitOptions,
        region: NDArray[np.float64] | None = None,
    ) -> None:
        self.space, self.options = space, options
        self.region = None if region is None else torch.from_numpy((region - CENTRE) / UNIT_LENGTH)
        self.target = TriangleMesh((target.vertices - CENTRE) / UNIT_LENGTH, target.faces)
        self.base = Surface(space.weights, space.faces)
        self.rest = torch.from_numpy(space.cage.handles)
        self.limit = space.scale * space.parameter_limit / UNIT_LENGTH
        self.random = torch.Generator().manual_seed(options.seed)
        self.draws = np.random.default_rng(options.seed)

    def surface(self, handles: Tensor) -> TriangleMesh:
        """The finger of (N, 3) handles, in metres."""
        vertices = (self.base.weights @ handles).numpy() * UNIT_LENGTH + CENTRE
        return TriangleMesh(vertices, self.space.faces)

    def target_samples(self, count: int) -> tuple[Tensor, Tensor]:
        points, normals = sample_surface(self.target, count, int(self.draws.integers(2**31)))
        return torch.from_numpy(points), torch.from_numpy(normals)

    def starts(self) -> Tensor:
        """(B, N, 3) rest cages turned, stretched to the target's spread, and scattered.

        The first quarter is not turned: targets are often aligned with the base mesh.
        """
        count = self.options.restarts
        turns = Rotation.random(count, random_state=self.options.seed).as_matrix()
        turns[: (count + 3) // 4] = np.eye(3)
        base = sample_surface(
            TriangleMesh((self.space.weights @ self.rest).numpy(), self.space.faces), 3000, 0
        )[0]
        goal = self.target_samples(3000)[0].numpy()
        turned = (base - base.mean(0)) @ turns.transpose(0, 2, 1)
        stretch = goal.std(0) / turned.std(1)
        cage = (self.rest.numpy() - base.mean(0)) @ turns.transpose(0, 2, 1)
        handles = torch.from_numpy(goal.mean(0) + cage * stretch[:, None])
        scatter = 0.3 * float(goal.std(0).mean())
        noise = torch.randn(handles.shape, generator=self.random, dtype=torch.float64)
        return handles + scatter * noise

    def search(self, progress: Progress) -> tuple[Tensor, list[float]]:
        """The restarts that are left before polishing, (K, N, 3), and the curve."""
        options = self.options
        handles, curve = self.starts(), []
        advance = _Adam(handles) if options.method == "adam" else _solve
        iterations = options.iterations * (10 if options.method == "adam" else 1)
        for index in range(iterations):
            share = index / iterations
            fading = 1.0 + 5.0 * (1.0 - share)  # normals matter most while shapes are far apart
            rows = self.rows(handles, options.samples, fading)
            distance = _distances(rows, handles)
            curve.append(float(distance.mean(1).min()) * UNIT_LENGTH)
            handles = self.limited(advance(rows, handles))
            progress(0.5 * share)
            if index == iterations // 3:
                handles = self.best(handles, max(options.polished, options.restarts // 3))
                advance = _Adam(handles) if options.method == "adam" else _solve
        return handles, curve

    def rows(self, handles: Tensor, count: int, fading: float) -> Rows:
        options = self.options
        finger = self.base.sample(handles, count, self.random)
        points, normals = self.target_samples(count)
        rows = chamfer_rows(finger, points, normals, fading * options.normal_weight / UNIT_LENGTH)
        return Rows.joined([self.emphasised(rows), *self.penalties(finger)])

    def emphasised(self, rows: Rows) -> Rows:
        """The rows; those with their goal in the region count more."""
        if self.region is None:
            return rows
        inside = ((rows.goals > self.region[0]) & (rows.goals < self.region[1])).all(-1)
        return replace(rows, importance=rows.importance * torch.where(inside, _EMPHASIS, 1.0))

    def penalties(self, finger: Samples) -> list[Rows]:
        options = self.options
        rows = []
        if options.wall > 0.0:
            rows.append(wall_rows(finger, options.wall / UNIT_LENGTH, 3.0))
        if options.closing:
            rows.append(closing_rows(finger, -float(CENTRE[1]) / UNIT_LENGTH, 3.0))
        return rows

    def limited(self, handles: Tensor) -> Tensor:
        """Handles kept well within the space's bounds."""
        reach = _WITHIN * self.limit
        return self.rest + (handles - self.rest).clamp(-reach, reach)

    def best(self, handles: Tensor, count: int) -> Tensor:
        """The `count` restarts that are nearest to the target, by 600 samples each way."""
        finger = self.base.sample(handles, 600, self.random).points
        points = self.target_samples(600)[0].numpy()
        scores = []
        for ours, each in zip(finger, handles, strict=True):
            fitted = TriangleMesh((self.base.weights @ each).numpy(), self.space.faces)
            there, back = distances_to(ours.numpy(), self.target), distances_to(points, fitted)
            scores.append(there.mean() + back.mean())
        return handles[torch.from_numpy(np.argsort(scores)[:count].copy())]

    def polish(self, handles: Tensor, iterations: int) -> tuple[Tensor, list[float]]:
        """Solves on with the surfaces' true nearest points.

        Returns:
            (N, 3), the mean of the last iterates, at most `_AVERAGED` and half of all, which evens
            out the fresh samples' scatter; and the curve.
        """
        iterates, least, since, curve = [handles], np.inf, 0, []
        for _ in range(iterations):
            rows, distance = self.exact_rows(handles)
            since = 0 if distance < 0.999 * least else since + 1
            least = min(least, distance)
            curve.append(least * UNIT_LENGTH)
            if since > self.options.patience:
                break
            handles = self.limited(_solve(rows, handles[None], nearest=0.2e-3, sliding=0.97)[0])
            iterates.append(handles)
        averaged = min(_AVERAGED, (len(iterates) + 1) // 2)
        return torch.stack(iterates[-averaged:]).mean(0), curve

    def exact_rows(self, handles: Tensor) -> tuple[Rows, float]:
        """Rows of one finger from its surface to the target's and back, and their mean length."""
        finger = self.base.sample(handles[None], _POLISH_SAMPLES, self.random)
        ours = finger.points[0].numpy()
        _, _, goals = igl.point_mesh_squared_distance(
            ours, self.target.vertices, self.target.faces.astype(np.int64)
        )
        points = self.target_samples(_POLISH_SAMPLES)[0]
        weights, nearest = self.base.nearest(handles, points.numpy())
        offsets = torch.cat([finger.points[0] - torch.from_numpy(goals), nearest - points])
        lengths = offsets.norm(dim=-1)
        rows = Rows(
            torch.cat([finger.weights[0], weights])[None],
            torch.cat([torch.from_numpy(goals), points])[None],
            (offsets / lengths.clamp_min(1e-9)[:, None])[None],
            torch.ones(1, len(offsets), dtype=torch.float64),
        )
        rows = Rows.joined([self.emphasised(rows), *self.penalties(finger)])
        return rows, float(lengths.mean())


def _distances(rows: Rows, handles: Tensor) -> Tensor:
    """(B, R) how far each row is from its goal; 0.3 of the way along the surface counts."""
    offsets = rows.weights @ handles - rows.goals
    along = (offsets * rows.directions).sum(-1)
    return (along.square() + 0.1 * offsets.square().sum(-1)).sqrt()


def _solve(rows: Rows, handles: Tensor, nearest: float = 0.3e-3, sliding: float = 0.8) -> Tensor:
    """Handles that minimise the rows' weighted squares, each weighted by 1 / its distance now.

    Args:
        nearest: distances below this count as this [m].
        sliding: how freely points move across their row's direction, 0 to 1.
    """
    batch, count, n = rows.weights.shape
    distance = _distances(rows, handles)
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


class _Adam:
    """The same step by gradient: Adam on the mean distance of the rows."""

    def __init__(self, handles: Tensor) -> None:
        self.handles = handles.clone().requires_grad_()
        self.optimizer = torch.optim.Adam([self.handles], lr=_ADAM_RATE)

    def __call__(self, rows: Rows, handles: Tensor) -> Tensor:
        with torch.no_grad():
            self.handles.copy_(handles)
        self.optimizer.zero_grad()
        (_distances(rows, self.handles) * rows.importance).mean(1).sum().backward()
        self.optimizer.step()
        return self.handles.detach()
