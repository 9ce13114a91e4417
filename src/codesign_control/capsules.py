"""The arm and its hand as capsules: a few thick lines that enclose every shape of the URDF.

A capsule is all points within `radius` of a segment. Distances between capsules are cheap and
exact, and what keeps two capsules apart keeps apart what they enclose.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize_scalar

from codesign_control.hand import TCP_FROM_FLANGE, Hand
from codesign_control.xarm7 import urdf

# Knuckles and finger links of the gripper over their whole stroke, in `gripper_base_link`; below
# them are the fingers. Pivots and cranks: gripper.py; the links are up to 10 mm thick.
LINKAGE = np.array([[-0.015, -0.085, 0.08], [0.015, 0.085, 0.13]])  # m, lower and upper corner
ARM = ("link_base", "link1", "link2", "link3", "link4", "link5", "link6")


@dataclass(frozen=True)
class Capsule:
    """A capsule of a link, in that link's frame; `fingers` are given in `link_tcp`.

    start, end: (3,) m, the segment's ends. radius: m.
    """

    link: str
    start: np.ndarray
    end: np.ndarray
    radius: float

    @property
    def body(self) -> int:
        """Links that no joint moves against each other: 0 the base, ... 7 the hand."""
        return ARM.index(self.link) if self.link in ARM else len(ARM)


def arm_capsules() -> list[Capsule]:
    """Capsules that enclose every collision shape of the arm's URDF."""
    found = []
    for link in ElementTree.fromstring(urdf()).iter("link"):
        for shape in link.iter("collision"):
            found += _enclosing(link.get("name", ""), shape)
    return found


def hand_capsules(hand: Hand) -> list[Capsule]:
    """Capsules around the gripper's knuckles and its fingers, from closed to fully open."""
    knuckles = _around_box("gripper_base_link", np.eye(3), LINKAGE.mean(axis=0), np.ptp(LINKAGE, 0))
    lower, upper = hand.swept_box()
    return knuckles + _around_box("fingers", np.eye(3), (lower + upper) / 2.0, upper - lower)


def placed(capsule: Capsule) -> tuple[str, np.ndarray, np.ndarray]:
    """(link of the URDF, start, end): the fingers' frame `link_tcp` is fixed to the flange."""
    if capsule.link != "fingers":
        return capsule.link, capsule.start, capsule.end
    shift = np.array([0.0, 0.0, TCP_FROM_FLANGE])
    return "gripper_base_link", capsule.start + shift, capsule.end + shift


# Pairs of bodies that are left to the joints' own limits: a single joint decides how near they
# come (base and link 2, 2 and 4, 4 and 6), or nothing brings them near (the rest: `tests` sample).
LEFT_ALONE = {(0, 2), (2, 4), (4, 6), (0, 3), (1, 3), (3, 5), (3, 6)}


def watched_pairs(capsules: list[Capsule]) -> list[tuple[int, int]]:
    """Indices of the capsules that are to be kept apart.

    Neither within a body nor of neighbours, which always touch, nor LEFT_ALONE, nor links 4 and 5
    and the bare flange, which joint 6 alone brings together.
    """
    return [
        (i, j)
        for i, a in enumerate(capsules)
        for j, b in enumerate(capsules)
        if b.body - a.body >= 2
        and (a.body, b.body) not in LEFT_ALONE
        and not (a.body in (4, 5) and b.link == "link7")
    ]


def _enclosing(link: str, shape: ElementTree.Element) -> list[Capsule]:
    origin, geometry = shape.find("origin"), shape.find("geometry")
    if origin is None or geometry is None:
        raise ValueError(f"{link}: collision shape without origin or geometry")
    centre = np.array(origin.get("xyz", "0 0 0").split(), dtype=float)
    turned = pin.rpy.rpyToMatrix(*(float(a) for a in origin.get("rpy", "0 0 0").split()))
    solid = geometry[0]
    if solid.tag == "sphere":
        return [Capsule(link, centre, centre, float(solid.get("radius", "nan")))]
    if solid.tag == "cylinder":
        half, radius = float(solid.get("length", "nan")) / 2, float(solid.get("radius", "nan"))
        return [_along(link, centre, turned[:, 2], half, radius)]
    if solid.tag == "box":
        return _around_box(link, turned, centre, np.array(solid.get("size", "").split(), float))
    raise ValueError(f"{link}: no capsule for a {solid.tag}")


def _around_box(
    link: str, turned: np.ndarray, centre: np.ndarray, size: np.ndarray
) -> list[Capsule]:
    """Two capsules along a box's longest side: one for each half of its middle side."""
    short, middle, long = np.argsort(size)
    quarter = size[middle] / 4.0
    radius = float(np.hypot(quarter, size[short] / 2.0))
    half, aside = size[long] / 2.0, quarter * turned[:, middle]
    return [_along(link, centre + side, turned[:, long], half, radius) for side in (-aside, aside)]


def _along(link: str, centre: np.ndarray, axis: np.ndarray, half: float, radius: float) -> Capsule:
    """The smallest capsule around a cylinder of this radius that reaches `half` both ways.

    A segment shorter than the cylinder needs a larger radius to hold its rims.
    """

    def radius_at(segment: float) -> float:
        return float(np.hypot(radius, half - segment))

    def volume(segment: float) -> float:
        return radius_at(segment) ** 2 * (segment + 2.0 / 3.0 * radius_at(segment))

    best = minimize_scalar(volume, bounds=(0.0, half), method="bounded").x
    best = best if best > 1e-4 else 0.0  # a sphere
    return Capsule(link, centre - best * axis, centre + best * axis, radius_at(best) + 1e-9)
