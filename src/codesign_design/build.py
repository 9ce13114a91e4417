"""From a raw surface to a finger pair that can be printed, screwed on and simulated."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import igl
import numpy as np

from codesign_design import mount as stock_mount
from codesign_design.finger_pair import MOUNT_FACE, FingerPair, TriangleMesh
from codesign_design.gripper_check import check_gripper
from codesign_design.gripper_geometry import usable_gap
from codesign_design.mesh_checks import (
    MeshChecks,
    check_mesh,
    edge_checks,
    is_valid,
    volume_and_centre,
)
from codesign_design.mount import MAX_DEPTH, Mounted, mount_finger
from codesign_design.mount_check import check_mount
from codesign_design.poisson import reconstruct
from codesign_design.printability import Deviation, PrintReport, check_printing
from codesign_design.repair import Repaired, repair, smoothed

SMOOTHING = (10, 5, 0)  # Taubin iterations: fewer where smoothing makes faces intersect


@dataclass(frozen=True)
class Shape:
    """A valid, mounted left finger on its way to a pair.

    Attributes:
        body: without the mount.
        mounted: with it.
        checks: of the mounted mesh.
        repaired: how the body was made; None where the raw surface was valid and is kept.
    """

    body: TriangleMesh
    mounted: Mounted
    checks: MeshChecks
    repaired: Repaired | None


@dataclass(frozen=True)
class BuiltFinger:
    """A finger pair, its report, and the surface it was made from."""

    pair: FingerPair
    report: PrintReport
    raw: TriangleMesh


def build_finger(
    surface: TriangleMesh,
    name: str = "",
    cage: str = "",
    parameters: Iterable[float] = (),
    mount: str = stock_mount.NAME,
    poisson: bool = False,
) -> BuiltFinger:
    """Repairs a raw surface where needed, mounts and mirrors it, and checks the result.

    Args:
        surface: left finger in the grasp frame at gap 0 [m]: contact side towards -y. It may
            intersect itself or have holes; a valid one keeps its sharp edges.
        name: for people.
        cage: design space that shaped it, empty for none.
        parameters: its design action.
        mount: "stock-m3x2", the only one there is.
        poisson: make the body from sampled points, as the paper does, even of a valid surface.

    Raises:
        ValueError: unknown mount, values that are not finite, or a surface without a solid. A
            finger that cannot be printed or used is built all the same; its report says why.
    """
    if mount != stock_mount.NAME:
        raise ValueError(f"mount {mount!r}: there is only {stock_mount.NAME!r}")
    return finish_finger(surface, shape_finger(surface, poisson), name, cage, parameters)


def finish_finger(
    surface: TriangleMesh,
    shape: Shape,
    name: str = "",
    cage: str = "",
    parameters: Iterable[float] = (),
) -> BuiltFinger:
    """The pair and its report from what `shape_finger` made of the raw surface."""
    left = shape.mounted.mesh
    gap = usable_gap(MOUNT_FACE + shape.mounted.depth)
    pair = FingerPair(
        name,
        left,
        left.mirrored_y(),
        *gap,
        cage,
        tuple(float(p) for p in parameters),
        stock_mount.NAME,
    )
    return BuiltFinger(pair, _report(pair, surface, shape), surface)


def shape_finger(surface: TriangleMesh, poisson: bool = False) -> Shape:
    """The mounted left finger alone, without the measures of the report.

    Raises:
        ValueError: like `build_finger`.
    """
    _check_input(surface)
    for body, repaired in _candidates(surface, poisson):
        mounted = mount_finger(body)
        shape = Shape(body, mounted, check_mesh(mounted.mesh), repaired)
        if shape.checks.valid:
            break
    return shape


def _candidates(
    surface: TriangleMesh, poisson: bool
) -> Iterator[tuple[TriangleMesh, Repaired | None]]:
    """The surface as it is if it is valid, then remeshed, the smoother first.

    The union with the mount can spoil a valid surface whose faces touch it edge on.
    """
    if not poisson and is_valid(surface):
        yield surface, None
    repaired = (reconstruct if poisson else repair)(surface, MAX_DEPTH)
    for iterations in SMOOTHING:
        yield smoothed(repaired.mesh, iterations), repaired


def _check_input(surface: TriangleMesh) -> None:
    if not len(surface.vertices) or not len(surface.faces):
        raise ValueError(
            f"the surface is empty: {len(surface.vertices)} vertices, {len(surface.faces)} faces"
        )
    if not np.isfinite(surface.vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(surface.vertices).all(axis=1))[0])
        raise ValueError(
            f"vertex {bad} of the surface is {surface.vertices[bad]}; all must be finite"
        )
    if surface.faces.min() < 0 or surface.faces.max() >= len(surface.vertices):
        raise ValueError(
            f"a face names vertex {surface.faces.max()}, there are {len(surface.vertices)}"
        )


def _report(pair: FingerPair, raw: TriangleMesh, shape: Shape) -> PrintReport:
    return PrintReport(
        name=pair.name,
        content_hash=pair.content_hash,
        mesh=shape.checks,
        mirrored=_is_mirrored(pair),
        printing=check_printing(pair.left),
        mount=check_mount(pair.left),
        gripper=check_gripper(pair.left),
        deviation=_deviation(raw, shape),
    )


def _is_mirrored(pair: FingerPair) -> bool:
    """Whether the right finger is the left one's mirror image, wound outward."""
    volume = volume_and_centre(pair.right)[0]
    same_points = np.array_equal(pair.right.vertices * [1.0, -1.0, 1.0], pair.left.vertices)
    return all(edge_checks(pair.right.faces)) and volume > 0 and same_points


def _deviation(raw: TriangleMesh, shape: Shape) -> Deviation:
    front = raw.vertices[:, 1].min()
    cut = max(0.0, float(raw.vertices[:, 1].max() - front) - shape.mounted.depth)
    if shape.repaired is None:
        return Deviation(False, 0.0, 0.0, 0.0, 0.0, shape.mounted.lost, cut)
    points = shape.body.vertices
    kept = points[points[:, 1] < points[:, 1].min() + shape.mounted.depth]
    squared, _, _ = igl.point_mesh_squared_distance(kept, raw.vertices, raw.faces.astype(np.int64))
    distance = np.sqrt(squared)
    return Deviation(
        remeshed=True,
        mean=float(distance.mean()),
        p95=float(np.percentile(distance, 95)),
        largest=float(distance.max()),
        volume_change=volume_and_centre(shape.body)[0] / shape.repaired.volume - 1.0,
        lost=max(shape.repaired.lost, shape.mounted.lost),
        cut=cut,
    )
