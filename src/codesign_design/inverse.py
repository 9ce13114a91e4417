"""Inverse design: the parameters whose finger comes closest to a target (paper Algorithm 1).

Many restarts run as one batch. "adam" is the paper's: gradient descent on the two-way Chamfer
distance of freshly sampled surfaces. "icp" alternates closest points with a closed-form solve for
all handles, reweighted so that it lowers the mean distance and not the mean square. Restarts that
fall behind are dropped on the way; the rest are polished against the surfaces themselves, all
briefly and the last few to the end.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from codesign_design.base_mesh import UNIT_LENGTH
from codesign_design.chamfer import chamfer_distance, volume_iou
from codesign_design.descent import Adam, distances, solve
from codesign_design.design_space import DesignSpace
from codesign_design.finger_pair import TriangleMesh
from codesign_design.fit_options import FitOptions
from codesign_design.fit_problem import FitProblem
from codesign_design.mesh_checks import check_closed

_BRIEF = 12  # polishing iterations of those that are left, before the last choice
_AVERAGED = 10  # last iterates of polishing, at most
_MEMORY = 0.7  # of a restart's score, from one iteration to the next

Progress = Callable[[float], None]
"""Called with the share of the work that is done, 0 to 1."""


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
        ValueError: the target is not closed; counts its open edges.
    """
    started = time.perf_counter()
    check_closed(target, "the target")
    options = options or FitOptions()
    problem = FitProblem(space, target, options, region)
    handles, curve = _search(problem, progress)
    brief = min(_BRIEF, options.polish_iterations)
    handles, lengths, _ = _polish(problem, handles, brief)
    progress(0.6)
    handles = handles[lengths.argsort(stable=True)[: options.polished]]
    handles, _, tail = _polish(problem, handles, options.polish_iterations)
    progress(0.9)
    surfaces = [problem.surface(each) for each in handles]
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
        problem.parameters(handles[kept]),
        chosen,
        float(chamfers[kept]),
        volume_iou(chosen, target),
        None if region is None else overlap[kept],
        time.perf_counter() - started,
        np.array(curve + tail),
        chamfers,
    )


def _search(problem: FitProblem, progress: Progress) -> tuple[Tensor, list[float]]:
    """The restarts that are left before polishing, (K, N, 3), and the curve."""
    options = problem.options
    handles, curve = problem.starts(), []
    score = torch.zeros(len(handles))
    advance = Adam(handles) if options.method == "adam" else solve
    iterations = options.iterations * (10 if options.method == "adam" else 1)
    for index in range(iterations):
        share = index / iterations
        fading = 1.0 + 5.0 * (1.0 - share)  # normals matter most while shapes are far apart
        rows = problem.sampled_rows(handles, fading)
        distance = distances(rows, handles).mean(1)
        score = _MEMORY * score + (1.0 - _MEMORY) * distance
        curve.append(float(distance.min()) * UNIT_LENGTH)
        handles = problem.limited(advance(rows, handles))
        progress(0.5 * share)
        if index == iterations // 3:
            kept = score.argsort(stable=True)[: max(options.polished, options.restarts // 3)]
            handles, score = handles[kept], score[kept]
            advance = Adam(handles) if options.method == "adam" else solve
    return handles, curve


def _polish(
    problem: FitProblem, handles: Tensor, iterations: int
) -> tuple[Tensor, Tensor, list[float]]:
    """Solves on with the surfaces' true nearest points until no restart improves.

    Returns:
        (K, N, 3), means of the last iterates, at most `_AVERAGED` and half of all, which evens out
        the fresh samples' scatter; (K,) the means of their distances, units; and the curve.
    """
    iterates, lengths, curve = [handles], [], []
    least = torch.full((len(handles),), torch.inf, dtype=torch.float64)
    since = torch.zeros(len(handles))
    for _ in range(iterations):
        rows, length = problem.exact_rows(handles)
        since = torch.where(length < 0.999 * least, 0, since + 1)
        least = torch.minimum(least, length)
        lengths.append(length)
        curve.append(float(least.min()) * UNIT_LENGTH)
        if (since > problem.options.patience).all():
            break
        handles = problem.limited(solve(rows, handles, nearest=0.2e-3, sliding=0.97))
        iterates.append(handles)
    averaged = min(_AVERAGED, (len(iterates) + 1) // 2)
    mean = torch.stack(iterates[-averaged:]).mean(0)
    return mean, torch.stack(lengths[-averaged:]).mean(0), curve
