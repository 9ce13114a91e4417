"""Files of finger design: parameters as JSON, surfaces as STL, in millimetres unless told."""

import json
import os
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from codesign_design.design_space import DesignSpace, design_space
from codesign_design.finger_pair import TriangleMesh
from codesign_design.mesh_checks import check_closed

UNITS = {"mm": 1e-3, "m": 1.0, "inch": 0.0254}
"""Length units of a surface file, in metres."""


def write_text(path: Path, text: str) -> None:
    """Writes the file in one step: readers see the old content or the new one."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    part.write_text(text)
    os.replace(part, path)


def write_parameters(path: Path, space: DesignSpace, parameters: NDArray[np.float64]) -> None:
    """Stores design parameters with the space and the cage version they belong to."""
    values = [float(value) for value in space.check(parameters)]
    content = {"space": space.name, "version": space.version, "parameters": values}
    write_text(path, json.dumps(content, indent=2) + "\n")


def read_parameters(path: Path) -> tuple[DesignSpace, NDArray[np.float64]]:
    """The space and the parameters that `write_parameters` stored.

    Raises:
        ValueError: not such a file, another version of the cage, or parameters out of bounds.
        OSError: cannot be read.
    """
    try:
        content = json.loads(path.read_text())
        name, version, parameters = (content[key] for key in ("space", "version", "parameters"))
    except (json.JSONDecodeError, UnicodeDecodeError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path} is not a parameter file: it must be JSON with space, version and parameters"
        ) from error
    space = design_space(name)
    if version != space.version:
        raise ValueError(
            f"{path} is for version {version} of {name}, this is version {space.version}: the "
            "cage has changed and the parameters mean another shape; fit the target again"
        )
    return space, space.check(parameters)


def read_surface(path: Path, unit: str = "mm") -> TriangleMesh:
    """A closed surface from an STL, OBJ or PLY file, in metres.

    Raises:
        ValueError: unknown unit, not a surface, empty, or not closed; counts the open edges.
        OSError: cannot be read.
    """
    if unit not in UNITS:
        raise ValueError(f"unit {unit!r}: choose from {', '.join(UNITS)}")
    with path.open("rb"):
        pass
    try:
        mesh = trimesh.load(path, force="mesh", process=True)
    except Exception as error:  # each format's reader raises its own
        raise ValueError(f"{path} cannot be read as a surface: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise ValueError(f"{path} holds no triangles; export it as an STL, OBJ or PLY surface")
    mesh.merge_vertices()
    check_closed(_surface(mesh, unit), str(path))
    mesh.fix_normals()
    return _surface(mesh, unit)


def _surface(mesh: trimesh.Trimesh, unit: str) -> TriangleMesh:
    vertices = np.array(mesh.vertices, dtype=np.float64) * UNITS[unit]
    return TriangleMesh(vertices, np.array(mesh.faces, dtype=np.int32))


def write_stl(path: Path, mesh: TriangleMesh) -> None:
    """Binary STL in millimetres."""
    part = path.with_name(f".{path.name}.{os.getpid()}")
    trimesh.Trimesh(mesh.vertices * 1e3, mesh.faces, process=False).export(part, file_type="stl")
    os.replace(part, path)
