"""A rigid finger's surface."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from codesign_sim.checks import require_finite, require_integers


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """A watertight triangle surface in the grasp frame at gap 0 (see `FingerTargets`).

    Args:
        vertices: (V, 3) in metres.
        faces: (F, 3) vertex indices, wound so that normals point outwards.
    Raises:
        ValueError: not finite, indices out of range, not watertight, wound inconsistently or
            inwards.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices = require_finite("mesh vertices", self.vertices, (-1, 3), "m")
        faces = require_integers("mesh faces", self.faces, (-1, 3), least=0)
        if len(faces) < 4:
            raise ValueError(f"mesh has {len(faces)} faces; a closed surface has at least 4")
        if faces.max() >= len(vertices):
            raise ValueError(
                f"mesh face names vertex {faces.max()}, but there are only {len(vertices)}"
            )
        _require_closed(faces, len(vertices))
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        volume = float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6
        if volume <= 0:
            raise ValueError(
                f"mesh volume is {volume:g} m^3, it must be above 0; "
                "reverse the faces so that they wind outwards"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @classmethod
    def box(cls, low: tuple[float, ...], high: tuple[float, ...]) -> SurfaceMesh:
        """An axis-aligned box between two corners, metres."""
        shape = trimesh.creation.box(bounds=np.array([low, high], dtype=float))
        return cls(shape.vertices, shape.faces)

    @cached_property
    def content_hash(self) -> str:
        """Same geometry, same hash."""
        digest = hashlib.sha256(self.vertices.tobytes())
        digest.update(self.faces.astype(np.int64).tobytes())
        return digest.hexdigest()

    @cached_property
    def normals_by_area(self) -> np.ndarray:
        """Outward normals (F, 3) whose length is the face's area, m^2."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.cross(b - a, c - a) / 2

    @property
    def area(self) -> float:
        """Of the whole surface, m^2."""
        return float(np.linalg.norm(self.normals_by_area, axis=1).sum())

    @cached_property
    def radius(self) -> float:
        """Largest distance of a vertex from the frame's origin, metres."""
        return float(np.linalg.norm(self.vertices, axis=1).max())


def _require_closed(faces: np.ndarray, vertices: int) -> None:
    """Every edge borders exactly two faces, which run along it in opposite ways."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    either = np.sort(np.minimum(start, end) * vertices + np.maximum(start, end))
    paired = len(either) % 2 == 0 and (either[::2] == either[1::2]).all()
    if not paired or (either[2::2] == either[1:-1:2]).any():
        _, uses = np.unique(either, return_counts=True)
        raise ValueError(
            f"mesh is not watertight: {(uses != 2).sum()} edges do not border exactly 2 faces; "
            "merge equal vertices and close the holes"
        )
    if (np.diff(np.sort(start * vertices + end)) == 0).any():
        raise ValueError("mesh faces are wound inconsistently; fix their winding")
