"""Measures the mount on a finished finger's mesh: face, holes, room for head and screwdriver."""

from dataclasses import dataclass

import numpy as np

from codesign_design.columns import Columns, crossings
from codesign_design.finger_pair import TriangleMesh
from codesign_design.mount import (
    BOTTOM,
    HALF_WIDTH,
    HEAD_DIAMETER,
    HOLE_DIAMETER,
    HOLES,
    TOP,
    WEB,
    grasp_z,
)
from codesign_design.solid import MM

DIAMETER_TOLERANCE = 0.1  # mm, that a hole may be too narrow
FLATNESS = 1e-3  # mm
FACE_SHARE = 0.99  # of the nominal face, holes left out

_PITCH = 0.2  # mm, of the columns that measure a hole
_FACE_PITCH = 0.5  # mm, of those that measure the face
_REACH = 3.2  # mm, of those around a hole, either way
_FAR = 0.01  # mm


@dataclass(frozen=True)
class MountCheck:
    """What is there of mount "stock-m3x2".

    Attributes:
        face_share: flat area on the mount face, over its nominal area without the holes.
        hole_diameters: of the free way through, per hole [mm].
        channel_diameters: of the free way from the contact side down to the web under the screw's
            head, per hole [mm].
        webs: thickness under the head, per hole [mm].
    """

    face_share: float
    hole_diameters: tuple[float, ...]
    channel_diameters: tuple[float, ...]
    webs: tuple[float, ...]

    @property
    def problems(self) -> list[str]:
        """What keeps the finger from being screwed on, each with its value and limit."""
        found = []
        if self.face_share < FACE_SHARE:
            found.append(
                f"mount face is {self.face_share:.0%} of its area, {FACE_SHARE:.0%} is needed"
            )
        for name, measured, nominal in (
            ("screw hole", self.hole_diameters, HOLE_DIAMETER),
            ("channel for head and screwdriver", self.channel_diameters, HEAD_DIAMETER),
        ):
            if min(measured) < nominal - DIAMETER_TOLERANCE:
                found.append(f"{name} is {min(measured):.2f} mm wide, {nominal} mm is needed")
        return found


def check_mount(left: TriangleMesh) -> MountCheck:
    """Measures the left finger, in the grasp frame at gap 0; its largest y is the mount face."""
    depth = float(left.vertices[:, 1].max()) * MM
    holes = [_hole(left, grasp_z(z), depth) for z in HOLES]
    through, channel, web = zip(*holes, strict=True)
    return MountCheck(_face_share(left, depth), through, channel, web)


def _hole(left: TriangleMesh, z: float, depth: float) -> tuple[float, float, float]:
    """Diameters of hole and channel, and thickness of the web [mm]."""
    reach = np.arange(-_REACH, _REACH, _PITCH) + _PITCH / 3.0
    columns = Columns(1, (z + reach) / MM, reach / MM)
    found = crossings(left, columns)
    first = np.full(columns.count, np.inf)
    np.minimum.at(first, found.column, found.height * MM)
    through = _diameter(first == np.inf)
    channel = _diameter(first > depth - WEB - _FAR)
    seat = first[(first < np.inf) & (first > depth - WEB - _FAR)]
    return through, channel, depth - float(np.median(seat)) if len(seat) else 0.0


def _diameter(free: np.ndarray) -> float:
    """Of the circle with as much area as the free columns [mm]."""
    return float(np.sqrt(4.0 * free.sum() / np.pi)) * _PITCH


def _face_share(left: TriangleMesh, depth: float) -> float:
    z = np.arange(grasp_z(BOTTOM), grasp_z(TOP), _FACE_PITCH) + _FACE_PITCH / 3.0
    x = np.arange(-HALF_WIDTH, HALF_WIDTH, _FACE_PITCH) + _FACE_PITCH / 3.0
    columns = Columns(1, z / MM, x / MM)
    found = crossings(left, columns)
    last = np.full(columns.count, -np.inf)
    np.maximum.at(last, found.column, found.height * MM)
    face = np.ones((len(z), len(x)), dtype=bool)
    for hole in HOLES:
        face &= np.hypot(z[:, None] - grasp_z(hole), x) > HOLE_DIAMETER / 2.0
    return float((last.reshape(face.shape)[face] > depth - FLATNESS).mean())
