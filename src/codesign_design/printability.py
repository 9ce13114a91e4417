"""Can it be printed, screwed on and used: measures of a finished finger, with limits.

Printed with the mount face on the bed and the contact side up, so that the contact face gets the
printer's best surface and the boss needs no support.
"""

import dataclasses
import json
from dataclasses import dataclass
from typing import Any

import igl
import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import TriangleMesh
from codesign_design.gripper_check import GripperCheck
from codesign_design.mesh_checks import MeshChecks
from codesign_design.mount_check import MountCheck

MIN_WALL = 0.0012  # m, three lines of a 0.4 mm nozzle: thinner walls break off
MAX_THIN_SHARE = 0.10  # of the surface; edges that taper to a tip are thin there by design
MIN_GAP = 0.0005  # m, narrower slots fuse in the print
MAX_NARROW_SHARE = 0.02  # of the surface facing a narrower slot
OVERHANG = np.radians(45.0)  # from the vertical: steeper undersides need support
BED = (0.18, 0.18, 0.18)  # m, of the smallest printers in common use
MAX_LOST = 0.05  # of the volume, in pieces that did not hang together with the finger

_RAYS = 2000
_SKIN = 1e-6  # m, from where a ray starts
_BUILD = np.array([0.0, -1.0, 0.0])  # upwards in the print, grasp frame of the left finger


@dataclass(frozen=True)
class PrintChecks:
    """Measures for the printer. Thicknesses are seen along the normal, from evenly spread points.

    Attributes:
        wall_p1, wall_median: first percentile and median of the wall thickness [m].
        thin_share: of the surface with a wall thinner than `MIN_WALL`.
        gap_p1: first percentile of the width of slots, where there are any [m]; None: no slots.
        narrow_share: of the surface facing a slot narrower than `MIN_GAP`.
        overhang_area: undersides that need support [m^2].
        size: x, y, z of the bounding box [m].
    """

    wall_p1: float
    wall_median: float
    thin_share: float
    gap_p1: float | None
    narrow_share: float
    overhang_area: float
    size: tuple[float, float, float]

    @property
    def problems(self) -> list[str]:
        """What keeps the finger from being printed, each with its value and limit."""
        found = []
        if self.thin_share > MAX_THIN_SHARE:
            found.append(
                f"{self.thin_share:.0%} of the walls are thinner than {MIN_WALL * 1e3:g} mm, "
                f"{MAX_THIN_SHARE:.0%} are allowed"
            )
        if self.narrow_share > MAX_NARROW_SHARE:
            found.append(
                f"{self.narrow_share:.0%} of the surface faces a slot narrower than "
                f"{MIN_GAP * 1e3:g} mm, {MAX_NARROW_SHARE:.0%} is allowed"
            )
        if any(have > room for have, room in zip(sorted(self.size), sorted(BED), strict=True)):
            size = " x ".join(f"{1e3 * s:.0f}" for s in self.size)
            bed = " x ".join(f"{1e3 * s:.0f}" for s in BED)
            found.append(f"measures {size} mm, the printer takes {bed} mm")
        return found

    @property
    def advice(self) -> list[str]:
        """What to mind when printing."""
        found = []
        if self.wall_p1 < MIN_WALL / 3.0:
            found.append(
                f"tapers to {self.wall_p1 * 1e3:.2f} mm: the printer will round such edges off"
            )
        if self.overhang_area > 0:
            found.append(
                f"{self.overhang_area * 1e6:.0f} mm^2 of undersides need support with the mount "
                "face on the bed"
            )
        return found


@dataclass(frozen=True)
class Deviation:
    """From the raw surface, before the mount.

    Attributes:
        remeshed: the raw surface was not valid and has been rebuilt.
        mean, p95, largest: distance of the rebuilt surface's vertices from the raw one [m].
        volume_change: by smoothing, over the solid enclosed by the raw surface.
        lost: volume in pieces that did not hang together, over the whole.
        cut: how far the raw body reached behind the mount face, where it is cut off [m].
    """

    remeshed: bool
    mean: float
    p95: float
    largest: float
    volume_change: float
    lost: float
    cut: float

    @property
    def problems(self) -> list[str]:
        """What makes the finger a different one from what was asked for."""
        if self.lost <= MAX_LOST:
            return []
        return [
            f"{self.lost:.0%} of the volume is in separate pieces and was dropped, "
            f"{MAX_LOST:.0%} is allowed"
        ]


@dataclass(frozen=True)
class PrintReport:
    """Everything that is known of a finished finger pair; lengths in metres, angles in radians.

    `mesh`, `printing` and `mount` are of the left finger; the right one is its mirror image.
    `mirrored`: that was verified, with its winding turned outward.
    """

    name: str
    content_hash: str
    mesh: MeshChecks
    mirrored: bool
    printing: PrintChecks
    mount: MountCheck
    gripper: GripperCheck
    deviation: Deviation

    @property
    def problems(self) -> list[str]:
        """Why the pair cannot be used; empty if it can."""
        parts = (self.mesh, self.printing, self.mount, self.gripper, self.deviation)
        mirror = (
            [] if self.mirrored else ["the right finger is no outward mirror image of the left"]
        )
        return [*mirror, *(problem for part in parts for problem in part.problems)]

    @property
    def valid(self) -> bool:
        """Printable, mountable and usable."""
        return not self.problems

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {
            "name": self.name,
            "valid": self.valid,
            "problems": self.problems,
            "advice": self.printing.advice,
            "units": {"length": "m", "area": "m^2", "volume": "m^3", "angle": "rad", "mount": "mm"},
            "orientation": "mount face on the bed, contact side up",
            "content_hash": self.content_hash,
            "mirrored": self.mirrored,
            **{
                part: dataclasses.asdict(getattr(self, part))
                for part in ("mesh", "printing", "mount", "gripper", "deviation")
            },
            "limits": {
                "min_wall": MIN_WALL,
                "max_thin_share": MAX_THIN_SHARE,
                "min_gap": MIN_GAP,
                "max_narrow_share": MAX_NARROW_SHARE,
                "overhang_angle": float(OVERHANG),
                "bed": BED,
                "max_lost": MAX_LOST,
            },
        }

    def to_json(self) -> str:
        """JSON text of `as_dict`."""
        return json.dumps(self.as_dict(), indent=2)


def check_printing(left: TriangleMesh) -> PrintChecks:
    """Measures the left finger, in the grasp frame; its largest y is the mount face."""
    corners = left.vertices[left.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    areas = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(areas, 1e-300)[:, None]
    points, face = _spread(corners, areas)
    tree = igl.AABB()
    mesh = left.vertices, left.faces.astype(np.int64)
    tree.init(*mesh)
    walls = _reach(tree, mesh, points, -normals[face])
    gaps = _reach(tree, mesh, points, normals[face])
    slots = gaps[np.isfinite(gaps)]
    walls = walls[np.isfinite(walls)]
    bed = left.vertices[:, 1].max() - 1e-6
    down = (normals @ _BUILD < -np.sin(OVERHANG)) & (corners[..., 1].min(axis=1) < bed)
    size = np.ptp(left.vertices, axis=0)
    return PrintChecks(
        wall_p1=float(np.percentile(walls, 1)),
        wall_median=float(np.median(walls)),
        thin_share=float((walls < MIN_WALL).mean()),
        gap_p1=float(np.percentile(slots, 1)) if len(slots) else None,
        narrow_share=float((gaps < MIN_GAP).mean()),
        overhang_area=float(areas[down].sum()),
        size=(float(size[0]), float(size[1]), float(size[2])),
    )


def _spread(
    corners: NDArray[np.float64], areas: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points spread evenly over the surface, always the same ones, and their faces."""
    total = np.cumsum(areas)
    random = np.random.default_rng(0)
    face = np.searchsorted(total, (np.arange(_RAYS) + 0.5) / _RAYS * total[-1])
    u, v = random.random((2, _RAYS))
    root = np.sqrt(u)
    weights = np.stack([1.0 - root, root * (1.0 - v), root * v], axis=1)
    return np.einsum("ij,ijk->ik", weights, corners[face]), face


def _reach(
    tree: igl.AABB,
    mesh: tuple[NDArray[np.float64], NDArray[np.int64]],
    points: NDArray[np.float64],
    directions: NDArray[np.float64],
) -> NDArray[np.float64]:
    """How far the surface is along rays from the surface [m]; inf for never."""
    hit, distance, _ = tree.intersect_ray_first(*mesh, points + _SKIN * directions, directions)
    return np.where(hit >= 0, distance + _SKIN, np.inf)
