"""URDF and MJCF of a finger pair: two bodies that slide apart along y from the grasp frame.

Both are in metres and kilograms. The bodies look like the full surface, collide as convex pieces,
and weigh what the solid weighs in `DENSITY`. Mesh files are named relative to the model's folder.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
import trimesh
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair, TriangleMesh

DENSITY = 1240.0  # kg/m^3, PLA, printed solid
_NOTE = "unit: metre, kilogram; grasp frame at gap 0; a joint's position is half the gap"


@dataclass(frozen=True)
class FingerFiles:
    """Mesh files of one finger: all of it, and its convex pieces."""

    name: str
    mesh: TriangleMesh
    surface: str
    pieces: Sequence[str]
    outward: int  # 1 for the left finger, which opens along +y, -1 for the right one


def urdf_text(pair: FingerPair, fingers: Sequence[FingerFiles]) -> str:
    """URDF of the pair."""
    robot = ElementTree.Element("robot", name=pair.name or "fingers")
    robot.append(ElementTree.Comment(_NOTE))
    ElementTree.SubElement(robot, "link", name="grasp_frame")
    for finger in fingers:
        robot.append(_urdf_link(finger))
        joint = ElementTree.SubElement(
            robot, "joint", name=f"{finger.name}_joint", type="prismatic"
        )
        ElementTree.SubElement(joint, "parent", link="grasp_frame")
        ElementTree.SubElement(joint, "child", link=finger.name)
        ElementTree.SubElement(joint, "axis", xyz=f"0 {finger.outward} 0")
        low, high = pair.min_width / 2, pair.max_width / 2
        limits = {"lower": f"{low:.9g}", "upper": f"{high:.9g}", "effort": "30", "velocity": "0.1"}
        ElementTree.SubElement(joint, "limit", limits)
        if finger is not fingers[0]:
            ElementTree.SubElement(joint, "mimic", joint=f"{fingers[0].name}_joint")
    return _text(robot)


def mjcf_text(pair: FingerPair, fingers: Sequence[FingerFiles]) -> str:
    """MJCF of the pair, for MuJoCo."""
    model = ElementTree.Element("mujoco", model=pair.name or "fingers")
    model.append(ElementTree.Comment(_NOTE))
    asset = ElementTree.SubElement(model, "asset")
    world = ElementTree.SubElement(model, "worldbody")
    for finger in fingers:
        body = ElementTree.SubElement(world, "body", name=finger.name)
        limits = f"{pair.min_width / 2:.9g} {pair.max_width / 2:.9g}"
        slide = {"type": "slide", "axis": f"0 {finger.outward} 0", "range": limits}
        ElementTree.SubElement(body, "joint", {"name": f"{finger.name}_joint", **slide})
        mass, centre, inertia = mass_properties(finger.mesh)
        moments = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        inertial = {
            "mass": f"{mass:.9g}",
            "pos": _numbers(centre),
            "fullinertia": _numbers(moments),
        }
        ElementTree.SubElement(body, "inertial", inertial)
        for number, file in enumerate([finger.surface, *finger.pieces]):
            name = f"{finger.name}_{number}"
            ElementTree.SubElement(asset, "mesh", name=name, file=file)
            seen = {"contype": "0", "conaffinity": "0", "group": "1"} if number == 0 else {}
            ElementTree.SubElement(
                body, "geom", {"name": name, "type": "mesh", "mesh": name, **seen}
            )
    equality = ElementTree.SubElement(model, "equality")
    first, second = (f"{finger.name}_joint" for finger in fingers)
    ElementTree.SubElement(equality, "joint", joint1=second, joint2=first)
    return _text(model)


def mass_properties(mesh: TriangleMesh) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Mass [kg], centre of mass [m], and inertia about it (3, 3) [kg m^2]."""
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    solid.density = DENSITY
    return float(solid.mass), np.array(solid.center_mass), np.array(solid.moment_inertia)


def _urdf_link(finger: FingerFiles) -> ElementTree.Element:
    link = ElementTree.Element("link", name=finger.name)
    mass, centre, inertia = mass_properties(finger.mesh)
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=_numbers(centre), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=f"{mass:.9g}")
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    moments = {f"i{'xyz'[i]}{'xyz'[j]}": f"{inertia[i, j]:.9g}" for i, j in pairs}
    ElementTree.SubElement(inertial, "inertia", moments)
    uses = [("visual", finger.surface), *(("collision", piece) for piece in finger.pieces)]
    for use, file in uses:
        geometry = ElementTree.SubElement(ElementTree.SubElement(link, use), "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=file, scale="1 1 1")
    return link


def _numbers(values: Sequence[float] | NDArray[np.float64]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _text(root: ElementTree.Element) -> str:
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
