"""What pulls at the handles in a fit, and where they start; in unit space."""

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from codesign_design.base_mesh import UNIT_LENGTH
from codesign_design.design_space import CENTRE, DesignSpace
from codesign_design.finger_pair import TriangleMesh
from codesign_design.fit_options import FitOptions
from codesign_design.fit_surfaces import Samples, Surface, Target
from codesign_design.matching import Rows, chamfer_rows, closing_rows, nearest_rows, wall_rows

_WITHIN = 0.75  # share of the bounds that a fit may use
_SPREAD_SAMPLES = 3000
_POLISH_SAMPLES = 600
_EMPHASIS = 4.0  # what target points within the region count for
_PENALTY = 3.0  # what rows of walls and closing count for


class FitProblem:
    """One design space and one target.

    Args:
        region: (2, 3) corners of a box [m] in which target points count more; None for no box.
    """

    def __init__(
        self,
        space: DesignSpace,
        target: TriangleMesh,
        options: FitOptions,
        region: NDArray[np.float64] | None = None,
    ) -> None:
        self.space, self.options = space, options
        self.region = None if region is None else torch.from_numpy((region - CENTRE) / UNIT_LENGTH)
        self.target = Target(TriangleMesh((target.vertices - CENTRE) / UNIT_LENGTH, target.faces))
        self.finger = Surface(space.weights, space.faces)
        self.rest = torch.from_numpy(space.cage.handles)
        self.reach = _WITHIN * space.scale * space.parameter_limit / UNIT_LENGTH
        self.random = torch.Generator().manual_seed(options.seed)

    def starts(self) -> Tensor:
        """(B, N, 3) rest cages turned, stretched to the target's spread, and scattered.

        The first quarter is not turned: targets are often aligned with the base mesh.
        """
        count = self.options.restarts
        turns = Rotation.random(count, random_state=self.options.seed).as_matrix()
        turns[: (count + 3) // 4] = np.eye(3)
        base = self.finger.sample(self.rest[None], _SPREAD_SAMPLES, self.random).points[0]
        goal = self.target.sample(_SPREAD_SAMPLES, self.random)[0]
        back = torch.from_numpy(turns.transpose(0, 2, 1).copy())
        stretch = goal.std(0) / ((base - base.mean(0)) @ back).std(1)
        handles = goal.mean(0) + ((self.rest - base.mean(0)) @ back) * stretch[:, None]
        noise = torch.randn(handles.shape, generator=self.random, dtype=torch.float64)
        return handles + 0.3 * goal.std(0).mean() * noise

    def sampled_rows(self, handles: Tensor, fading: float) -> Rows:
        """Rows between fresh samples of the (B, N, 3) fingers and of the target.

        Args:
            fading: factor on the weight of normals.
        """
        options = self.options
        finger = self.finger.sample(handles, options.samples, self.random)
        points, normals = self.target.sample(options.samples, self.random)
        weight = fading * options.normal_weight / UNIT_LENGTH
        return self._wished(chamfer_rows(finger, points, normals, weight), finger)

    def exact_rows(self, handles: Tensor) -> tuple[Rows, Tensor]:
        """Rows from fresh samples to the other surface itself, and their mean lengths (B,)."""
        finger = self.finger.sample(handles, _POLISH_SAMPLES, self.random)
        points = self.target.sample(_POLISH_SAMPLES, self.random)[0]
        rows, lengths = nearest_rows(
            finger,
            self.target.nearest(finger.points),
            points,
            *self.finger.nearest(handles, points),
        )
        return self._wished(rows, finger), lengths

    def limited(self, handles: Tensor) -> Tensor:
        """Handles kept well within the space's bounds."""
        return self.rest + (handles - self.rest).clamp(-self.reach, self.reach)

    def parameters(self, handles: Tensor) -> NDArray[np.float64]:
        """(3N,) parameters of (N, 3) handles."""
        return self.space.parameters_of(handles.numpy() * UNIT_LENGTH + CENTRE)

    def surface(self, handles: Tensor) -> TriangleMesh:
        """The finger of (N, 3) handles, in metres."""
        vertices = (self.finger.weights @ handles).numpy() * UNIT_LENGTH + CENTRE
        return TriangleMesh(vertices, self.space.faces)

    def _wished(self, rows: Rows, finger: Samples) -> Rows:
        """The rows, those with their goal in the region counting more, and the penalties'."""
        options = self.options
        parts = [rows]
        if self.region is not None:
            inside = ((rows.goals > self.region[0]) & (rows.goals < self.region[1])).all(-1)
            factor = torch.where(inside, _EMPHASIS, 1.0)
            parts = [replace(rows, importance=rows.importance * factor)]
        if options.wall > 0.0:
            parts.append(wall_rows(finger, options.wall / UNIT_LENGTH, _PENALTY))
        if options.closing:
            parts.append(closing_rows(finger, -float(CENTRE[1]) / UNIT_LENGTH, _PENALTY))
        return Rows.joined(parts)
