"""A user's own soft object, read from a tetrahedral mesh."""

from __future__ import annotations

import contextlib
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from codesign_sim.checks import require_positive
from codesign_sim.soft_object import SoftObject, tetrahedron_volumes
from codesign_sim.tet_checks import quality, require_sound


@dataclass(frozen=True, eq=False)
class TetrahedralMesh(SoftObject):
    """A soft object of any shape. It stands on the table as it is given, z up.

    The nodes are moved so that the object frame's origin is the centre of mass.

    Args:
        nodes: (N, 3) in metres.
        tetrahedra: (T, 4) node indices, positively oriented.
    Raises:
        ValueError: a mesh that is not sound; see `tet_checks.require_sound`.
    """

    nodes: np.ndarray
    tetrahedra: np.ndarray

    def __post_init__(self) -> None:
        nodes, tetrahedra = require_sound(self.nodes, self.tetrahedra)
        volumes = tetrahedron_volumes(nodes, tetrahedra)
        centre = volumes @ nodes[tetrahedra].mean(axis=1) / volumes.sum()
        object.__setattr__(self, "nodes", nodes - centre)
        object.__setattr__(self, "tetrahedra", tetrahedra)

    @classmethod
    def from_file(cls, path: Path | str, scale: float = 1.0) -> TetrahedralMesh:
        """Reads any format of meshio (Gmsh, VTK, Abaqus, Medit, ...).

        Args:
            path: the file.
            scale: metres per unit of the file, 0.001 for millimetres.
        Raises:
            ValueError: a file that cannot be read, has no tetrahedra or is not sound.
        Warns:
            UserWarning: other cells beside the tetrahedra, which are ignored.
        """
        path = Path(path)
        require_positive("scale", scale, ())
        points, cells = _read(path)
        others = {kind: len(data) for kind, data in cells if kind != "tetra"}
        other_kinds = ", ".join(f"{count} {kind}" for kind, count in others.items())
        tetrahedra = [data for kind, data in cells if kind == "tetra"]
        if not tetrahedra:
            raise ValueError(
                f"{path} has no tetrahedra, only {other_kinds or 'points'}; mesh its volume with "
                "4-node tetrahedra"
            )
        if others:
            warnings.warn(f"{path.name}: ignored {other_kinds} beside the tetrahedra", stacklevel=2)
        return cls(scale * points, np.concatenate(tetrahedra))

    @property
    def size(self) -> tuple[float, float, float]:  # type: ignore[override]
        """Lengths of the smallest box around it along x, y, z, m."""
        x, y, z = np.ptp(self.nodes, axis=0)
        return float(x), float(y), float(z)

    @property
    def worst_quality(self) -> float:
        """Smallest mean ratio of a tetrahedron, 1 for regular ones."""
        return float(quality(self.nodes, self.tetrahedra).min())


def _read(path: Path) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    """Points and (kind, cells) blocks of a file."""
    import meshio

    if not path.is_file():
        raise ValueError(f"no mesh file {path}")
    try:
        with contextlib.redirect_stdout(sys.stderr):  # meshio reports failures on it
            mesh = meshio.read(path)
    except (Exception, SystemExit) as error:  # readers raise whatever the content leads to
        raise ValueError(
            f"cannot read {path} as a mesh ({type(error).__name__}: {error}); use a format that "
            "meshio knows, such as .msh, .vtk, .vtu, .inp or .mesh"
        ) from error
    return np.asarray(mesh.points, dtype=float), [(block.type, block.data) for block in mesh.cells]
