"""Five target fingers on which fits are measured, 46 to 48 mm long, as closed surfaces.

Left fingers in the grasp frame of `FingerPair`, made like CAD parts: fillets of 1 mm, flat and
curved faces that no cage can make exactly. Dimensions in millimetres.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray

from codesign_design.finger_pair import TriangleMesh
from codesign_design.stock import CENTRE_Z_IN_LINK, LINK_Z

_FILLET = 1.0
_LENGTH = 48.0
_WIDTH = 30.0
_SCOOP_PLATE, _SCOOP_LIP = 7.0, 16.0  # thickness; length in front of the plate
_SCOOP_LIP_ROOT = 5.0  # thickness of the lip where it leaves the plate

# (2, 3) corners [m] of the box in which only the scoop's lip lies: in front of its plate.
_Z_CENTRE = CENTRE_Z_IN_LINK + LINK_Z
SCOOP_LIP_REGION = np.array(
    [[-0.1, -0.1, _Z_CENTRE + 0.004], [0.1, _SCOOP_LIP * 1e-3, _Z_CENTRE + 0.1]]
)


def target_names() -> list[str]:
    """The five targets."""
    return list(_MAKERS)


@cache
def target(name: str) -> TriangleMesh:
    """The target of that name.

    Raises:
        ValueError: no such target.
    """
    if name not in _MAKERS:
        raise ValueError(f"no target {name!r}; choose from {', '.join(_MAKERS)}")
    mesh = _MAKERS[name]().to_mesh()
    vertices = np.asarray(mesh.vert_properties, dtype=np.float64)[:, :3] * 1e-3
    return centred(TriangleMesh(vertices, np.asarray(mesh.tri_verts, dtype=np.int32)))


def centred(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh moved to the stock pad's place: foremost point at y = 0, centred in x and z."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle = (low + high) / 2
    offset = np.array([middle[0], low[1], middle[2] - _Z_CENTRE])
    return TriangleMesh(mesh.vertices - offset, mesh.faces)


def _hull(corners: NDArray[np.float64]) -> Manifold:
    """The convex body around balls of the fillet's radius at the corners."""
    ball = Manifold.sphere(_FILLET, 24)
    return Manifold.batch_hull([ball.translate(corner) for corner in corners])


def _cuboid(x: float, y: float, z: float) -> Manifold:
    half = np.array([x, y, z]) / 2 - _FILLET
    signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
    return _hull(signs * half)


def _extruded(profile: list[tuple[float, float]]) -> Manifold:
    """A convex (y, z) profile over the full width."""
    half = _WIDTH / 2 - _FILLET
    return _hull(np.array([[x, y, z] for x in (-half, half) for y, z in profile]))


def _flat() -> Manifold:
    """A plate."""
    return _cuboid(_WIDTH, 10.0, _LENGTH)


def _cup() -> Manifold:
    """A plate with a spherical hollow 6 mm deep in its front."""
    depth, radius = 12.0, 55.0
    centre = -depth / 2 + 6.0 - radius
    return _cuboid(32.0, depth, _LENGTH) - Manifold.sphere(radius, 200).translate([0, centre, 0])


def _scoop() -> Manifold:
    """A plate with a lip over its full width at the lower end, thinning towards its edge."""
    plate = _cuboid(_WIDTH, _SCOOP_PLATE, _LENGTH)
    low = _LENGTH / 2 - _FILLET
    front = -_SCOOP_PLATE / 2
    edge, root = front - _SCOOP_LIP + _FILLET, low - _SCOOP_LIP_ROOT + 2 * _FILLET
    lip = _extruded([(edge, low), (edge, low - 1.0), (0.0, low), (front, root), (0.0, root)])
    return plate + lip


def _wedge() -> Manifold:
    """Thinner towards its lower end: 17 mm to 5 mm."""
    low = _LENGTH / 2 - _FILLET
    return _extruded([(-6.0, -low), (9.0, -low), (-6.0, low), (-3.0, low)])


def _box() -> Manifold:
    """The outline of the stock finger's frame, 14 mm deep."""
    return _cuboid(32.0, 14.0, 46.0)


_MAKERS: dict[str, Callable[[], Manifold]] = {
    "flat": _flat,
    "cup": _cup,
    "scoop": _scoop,
    "wedge": _wedge,
    "box": _box,
}
