"""Design spaces: finger surfaces as a linear function of 3N bounded parameters (paper III-A).

A space is a base mesh in its rest cage. The parameters a_D are the handles' displacements, x, y, z
of one handle after the other, divided by `DISPLACEMENT_SCALE`; zero is the base mesh itself. Unit
space is placed in the grasp frame with its origin at `CENTRE` and a unit of 24 mm, so the unit
sphere becomes a body 48 mm across, centred on the stock finger's pad.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from codesign_design.base_mesh import UNIT_LENGTH, base_mesh
from codesign_design.cage import Cage, cage_names, load_cage
from codesign_design.coordinates import mean_value_coordinates
from codesign_design.finger_pair import TriangleMesh
from codesign_design.stock import CENTRE_Z_IN_LINK, LINK_Z

CENTRE = np.array([0.0, 0.008, CENTRE_Z_IN_LINK + LINK_Z])  # m, unit space's origin, grasp frame
DISPLACEMENT_SCALE = 4.0  # units of displacement at parameter 1: fits need up to three
PARAMETER_LIMIT = 1.0


@dataclass(frozen=True)
class DesignSpace:
    """A base mesh and its cage, placed in the grasp frame.

    Attributes:
        cage: rest cage, in unit space.
        faces: (F, 3) int32, the same for every design.
        weights: (V, N) float64, mean value coordinates of the base mesh in the rest cage.
        parameter_limit: parameters lie within plus and minus this.
        scale: length of a handle's displacement at parameter 1 [m].
    """

    cage: Cage
    faces: NDArray[np.int32]
    weights: Tensor
    parameter_limit: float = PARAMETER_LIMIT
    scale: float = DISPLACEMENT_SCALE * UNIT_LENGTH

    @property
    def name(self) -> str:
        """Base mesh and number of handles, e.g. "sphere-7"."""
        return self.cage.name

    @property
    def version(self) -> int:
        """Version of the cage: parameters belong to it."""
        return self.cage.version

    @property
    def handles(self) -> int:
        """Number of handles N."""
        return len(self.cage.handles)

    @property
    def parameter_count(self) -> int:
        """3 N."""
        return 3 * self.handles

    @property
    def rest_handles(self) -> NDArray[np.float64]:
        """(N, 3) handles of the rest cage in the grasp frame [m]."""
        return self.cage.handles * UNIT_LENGTH + CENTRE

    def check(self, parameters: ArrayLike) -> NDArray[np.float64]:
        """The parameters as (3N,) float64.

        Raises:
            ValueError: wrong length, not numbers, not finite, or beyond the limit; names the
                index, its value and the limit.
        """
        try:
            values = np.asarray(parameters, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"parameters must be {self.parameter_count} numbers") from error
        if values.shape != (self.parameter_count,):
            raise ValueError(
                f"parameters have shape {values.shape}; {self.name} takes "
                f"({self.parameter_count},): x, y, z for each of {self.handles} handles"
            )
        wrong = np.flatnonzero(~(np.abs(values) <= self.parameter_limit))
        if len(wrong):
            index = int(wrong[0])
            raise ValueError(
                f"parameter {index} is {values[index]:g}; it must be a number within "
                f"+-{self.parameter_limit:g} (axis {'xyz'[index % 3]} of handle {index // 3})"
            )
        return values

    def handles_at(self, parameters: ArrayLike) -> NDArray[np.float64]:
        """(N, 3) handles of the deformed cage in the grasp frame [m]; raises like `check`."""
        return self.rest_handles + self.scale * self.check(parameters).reshape(-1, 3)

    def parameters_of(self, handles: ArrayLike) -> NDArray[np.float64]:
        """(3N,) parameters that put the handles at (N, 3) [m]; the inverse of `handles_at`.

        Raises:
            ValueError: like `check`, for handles too far from their rest place.
        """
        return self.check(((np.asarray(handles) - self.rest_handles) / self.scale).ravel())

    def deform(self, parameters: Tensor) -> Tensor:
        """Vertices of many designs, differentiable and without checks.

        Args:
            parameters: (B, 3N) float64.

        Returns:
            (B, V, 3) float64 in the grasp frame [m].
        """
        offsets = self.scale * parameters.reshape(-1, self.handles, 3)
        return self.weights @ (torch.from_numpy(self.rest_handles) + offsets)

    def deformed(self, parameters: ArrayLike) -> TriangleMesh:
        """The left finger's raw surface where the handles put it; raises like `check`.

        Closed, but it may intersect itself and carries no mount.
        """
        return TriangleMesh(self.weights.numpy() @ self.handles_at(parameters), self.faces)

    def surface(self, parameters: ArrayLike) -> TriangleMesh:
        """`deformed`, moved along y so that its foremost point is at y = 0."""
        mesh = self.deformed(parameters)
        front = mesh.vertices[:, 1].min()
        return TriangleMesh(mesh.vertices - [0.0, front, 0.0], self.faces)


def design_space_names() -> list[str]:
    """Every design space there is, e.g. "sphere-7"."""
    return cage_names()


@cache
def design_space(name: str) -> DesignSpace:
    """The design space of that name: base mesh, hyphen, number of handles.

    Raises:
        ValueError: no such space.
    """
    cage = load_cage(name)
    base = base_mesh(name.rpartition("-")[0])
    weights = mean_value_coordinates(
        torch.from_numpy(base.vertices),
        torch.from_numpy(cage.handles),
        torch.from_numpy(cage.faces.astype(np.int64)),
    )
    return DesignSpace(cage, base.faces, weights)
