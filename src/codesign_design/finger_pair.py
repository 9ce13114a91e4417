"""A finger pair as one value: what the simulator, the design service and the exporter share."""

import hashlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

MOUNT_FACE = 0.019  # m, from the finger link's origin along the closing direction
MAX_TRIANGLES = 200_000  # of a surface from outside
SIZES = (0.005, 0.2)  # m, its longest side


@dataclass(frozen=True)
class TriangleMesh:
    """A closed triangle surface, counter-clockwise seen from outside.

    Attributes:
        vertices: (V, 3) float64 [m].
        faces: (F, 3) int32 vertex indices.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]

    def mirrored_y(self) -> "TriangleMesh":
        """The mirror image across the plane y = 0, with its winding turned back outward."""
        return TriangleMesh(self.vertices * [1.0, -1.0, 1.0], self.faces[:, ::-1].copy())


def check_surface(mesh: TriangleMesh, name: str) -> None:
    """Whether a mesh from outside can be a finger.

    Raises:
        ValueError: too many triangles, not finite, wrong indices, or not of a finger's size.
    """
    if not 4 <= len(mesh.faces) <= MAX_TRIANGLES:
        raise ValueError(
            f"{name} has {len(mesh.faces)} triangles: must be 4 to {MAX_TRIANGLES}; simplify it"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise ValueError(f"{name} has a triangle that names a vertex beyond {len(mesh.vertices)}")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"{name} has a vertex that is not finite")
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if not SIZES[0] <= size <= SIZES[1]:
        raise ValueError(
            f"{name} is {size:g} m long: must be {SIZES[0]} to {SIZES[1]} m; is it in metres?"
        )


@dataclass(frozen=True)
class FingerPair:
    """A left and a right finger in the grasp frame at gap 0.

    Grasp frame: origin between the fingers' most protruding points at the height of the tool
    centre point with the gripper's drive closed, x sideways, y along the opening direction (left
    finger at y >= 0), z along the approach direction, out of the gripper. At gap w the left mesh
    moves by +w/2 along y and the right one by -w/2.

    Attributes:
        name: for people.
        left, right: surfaces [m].
        min_width, max_width: usable gap [m].
        cage: cage that shaped it, empty for none.
        parameters: design action a_D, 3 numbers per cage handle.
        mount: how it is fastened.
    """

    name: str
    left: TriangleMesh
    right: TriangleMesh
    min_width: float
    max_width: float
    cage: str = ""
    parameters: tuple[float, ...] = field(default=())
    mount: str = ""

    @property
    def content_hash(self) -> str:
        """SHA-256 of geometry and limits; equal for equal fingers, whatever their name."""
        digest = hashlib.sha256()
        for mesh in (self.left, self.right):
            digest.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
            digest.update(np.ascontiguousarray(mesh.faces, dtype="<i4").tobytes())
        digest.update(np.array([self.min_width, self.max_width], dtype="<f8").tobytes())
        return digest.hexdigest()

    @property
    def protrusion(self) -> float:
        """From the finger link's origin to the most protruding point, along the closing [m].

        The mount face, where the mesh ends, is 0.019 m from that origin on the stock finger.
        """
        return MOUNT_FACE + float(self.left.vertices[:, 1].max())

    @property
    def tip_depth(self) -> float:
        """How far the finger tips reach beyond the tool centre point along the approach [m]."""
        return float(max(self.left.vertices[:, 2].max(), self.right.vertices[:, 2].max()))
