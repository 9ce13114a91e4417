"""Expert fingers for tofu, modelled in code: the demonstrations of design (paper, Figure 4).

Each shape function returns the raw left finger in the grasp frame at gap 0 (see `FingerPair`): the
contact side faces -y, the most protruding point is at y = 0, the body ends at the mount face.
`expert` makes the mounted pair of it, as it does for any other surface.
"""

from collections.abc import Callable

import numpy as np
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray

from codesign_design.build import build_finger
from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_design.stock import CENTRE_Z_IN_LINK, FRAME_HEIGHT, LINK_Z, stock_fingers

PAD_TIP = CENTRE_Z_IN_LINK + LINK_Z + FRAME_HEIGHT / 2.0  # m, where the stock finger's tip is
# The lip works at table height with the gripper wide open, when the four-bar has drawn the fingers
# 4 mm back; the arm's tool centre point must stay above the table then.
SCOOP_TIP = PAD_TIP + 0.005  # m

_MM = 1e3  # the kernel works in millimetres
_FILLET_SEGMENTS = 24  # of a full circle
_CUP_FACET = 0.002  # m


def flat_pad(
    width: float = 0.060, height: float = 0.045, depth: float = 0.007, edge_radius: float = 0.0007
) -> TriangleMesh:
    """A wide flat pad, larger than the block's 50 x 40 mm side, so that no edge presses on it.

    Args:
        width: along x [m], 0.02..0.09.
        height: along z [m], 0.02..0.06; the pad ends at the stock finger's tip.
        depth: pad face to mount face [m], 0.004..0.02.
        edge_radius: fillet around the pad face [m], 0.0002..0.003.

    Raises:
        ValueError: an argument outside its range.
    """
    return _surface(_plate(width, height, depth, edge_radius, PAD_TIP))


def cupped_pad(
    cup: float = 0.00025,
    width: float = 0.060,
    height: float = 0.045,
    depth: float = 0.007,
    edge_radius: float = 0.0007,
) -> TriangleMesh:
    """The flat pad with a shallow hollow: its rim, beside the block, protrudes most.

    The block bulges when it is squeezed; a hollow of the same shape evens the pressure out.

    Args:
        cup: depth of the hollow in its middle [m], 0.0001..0.002.
        width, height, depth, edge_radius: as of `flat_pad`.

    Raises:
        ValueError: an argument outside its range.
    """
    _require("cup", cup, 0.0001, 0.002)
    plate = _plate(width, height, depth, edge_radius, PAD_TIP).refine_to_length(_CUP_FACET * _MM)
    half = np.array([width, height]) / 2.0 * _MM
    middle = (PAD_TIP - height / 2.0) * _MM

    def hollow(points: NDArray[np.float64]) -> NDArray[np.float64]:
        # A paraboloid along either axis, down to nothing at the rim and at the mount face.
        x, z = points[:, 0] / half[0], (points[:, 2] - middle) / half[1]
        sunk = cup * _MM * np.clip(1.0 - x**2, 0.0, 1.0) * np.clip(1.0 - z**2, 0.0, 1.0)
        return points + np.outer(sunk * (1.0 - points[:, 1] / (depth * _MM)), [0.0, 1.0, 0.0])

    cupped = plate.warp_batch(hollow)
    return _surface(cupped.translate((0.0, -cupped.bounding_box()[1], 0.0)))


def scoop(
    lip: float = 0.012,
    lip_thickness: float = 0.0015,
    chamfer: float = 0.0072,
    tip_thickness: float = 0.0003,
    width: float = 0.060,
    height: float = 0.050,
    depth: float = 0.006,
    edge_radius: float = 0.0007,
) -> TriangleMesh:
    """A flat pad on a full-width lip that slides under the block and carries its weight.

    Args:
        lip: how far the lip protrudes beyond the pad [m], 0.003..0.014; two of them must fit
            under the 30 mm block.
        lip_thickness: [m], 0.001..0.004.
        chamfer: length of the lip's wedge, from its tip [m], up to the lip's length.
        tip_thickness: of the wedge's front edge [m], 0.0003 up to the lip's thickness.
        width, height, depth, edge_radius: of the pad behind it, as of `flat_pad`.

    Raises:
        ValueError: an argument outside its range.
    """
    _require("lip", lip, 0.003, 0.014)
    _require("lip_thickness", lip_thickness, 0.001, 0.004)
    _require("chamfer", chamfer, 0.0, lip)
    _require("tip_thickness", tip_thickness, 0.0003, lip_thickness)
    plate = _plate(width, height, depth, edge_radius, SCOOP_TIP).translate((0.0, lip * _MM, 0.0))
    inside = lip + depth / 2.0  # the lip begins well inside the plate
    outline = np.array(
        [
            [0.0, SCOOP_TIP - tip_thickness],
            [chamfer, SCOOP_TIP - lip_thickness],
            [inside, SCOOP_TIP - lip_thickness],
            [inside, SCOOP_TIP],
            [0.0, SCOOP_TIP],
        ]
    )
    # Extruded along z, then turned: the outline's x, y become our y, z.
    blade = CrossSection([outline * _MM]).extrude(width * _MM)
    blade = blade.transform([[0, 0, 1, -width / 2 * _MM], [1, 0, 0, 0], [0, 1, 0, 0]])
    return _surface(plate + blade)


_SHAPES: dict[str, Callable[[], TriangleMesh]] = {
    "flat_pad": flat_pad,
    "cupped_pad": cupped_pad,
    "scoop": scoop,
}


def expert_names() -> list[str]:
    """Names that `expert` knows; "stock" is the baseline."""
    return ["stock", *_SHAPES]


def expert_surface(name: str) -> TriangleMesh:
    """The raw left surface of an expert finger, with its default dimensions.

    Raises:
        ValueError: unknown name, or "stock", which is a finished pair.
    """
    if name not in _SHAPES:
        raise ValueError(f"expert surface {name!r}: unknown; there are {', '.join(_SHAPES)}")
    return _SHAPES[name]()


def expert(name: str) -> FingerPair:
    """The mounted pair of an expert's shape with its default dimensions, or the stock fingers.

    Raises:
        ValueError: unknown name.
    """
    if name == "stock":
        return stock_fingers()
    return build_finger(expert_surface(name), name).pair


def _plate(width: float, height: float, depth: float, radius: float, tip: float) -> Manifold:
    """A plate with filleted front and side edges, from y = 0 to `depth`, ending at z = `tip`."""
    _require("width", width, 0.020, 0.090)
    _require("height", height, 0.020, 0.060)
    _require("depth", depth, 0.004, 0.020)
    _require("edge_radius", radius, 0.0002, 0.003)
    posts = []
    for x in (-width / 2.0 + radius, width / 2.0 - radius):
        for z in (tip - height + radius, tip - radius):
            ball = Manifold.sphere(radius * _MM, _FILLET_SEGMENTS)
            post = Manifold.cylinder((depth - radius) * _MM, radius * _MM, -1.0, _FILLET_SEGMENTS)
            upright = post.rotate((-90.0, 0.0, 0.0))  # from z along +y
            posts.append((ball + upright).translate(tuple(np.array([x, radius, z]) * _MM)))
    return Manifold.batch_hull(posts)


def _require(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} is {value} m: must be within {low}..{high} m")


def _surface(solid: Manifold) -> TriangleMesh:
    mesh = solid.to_mesh64()
    vertices = np.asarray(mesh.vert_properties[:, :3], dtype=np.float64) / _MM
    return TriangleMesh(vertices, np.asarray(mesh.tri_verts, dtype=np.int32))
