"""The arm's and the gripper body's shapes as props of a rendered scene, at any posture."""

from typing import Any

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from codesign_control.xarm7 import urdf
from codesign_report.scene import Prop


class ArmShape:
    """Cylinders, boxes and spheres of `xarm7.urdf`. `props` move with `place`."""

    def __init__(self) -> None:
        self._model = pin.buildModelFromXML(urdf())
        self._geometry = pin.buildGeomFromUrdfString(self._model, urdf(), pin.GeometryType.VISUAL)
        self._data = self._model.createData()
        self._placements = self._geometry.createData()
        self.props = [_prop(item) for item in self._geometry.geometryObjects]

    def place(self, joints: NDArray[np.float64]) -> None:
        """Moves the props to where the links are at joints (7,) [rad]."""
        pin.updateGeometryPlacements(
            self._model, self._data, self._geometry, self._placements, np.asarray(joints)
        )
        for prop, placement in zip(self.props, self._placements.oMg, strict=True):
            prop.position = placement.translation.copy()
            prop.rotation = placement.rotation.copy()


def _prop(item: Any) -> Prop:
    shape = item.geometry
    color = tuple(float(c) for c in item.meshColor)
    if isinstance(shape, coal.Cylinder):
        return Prop("cylinder", (shape.radius, shape.halfLength), color)
    if isinstance(shape, coal.Box):
        return Prop("box", tuple(float(h) for h in shape.halfSide), color)
    if isinstance(shape, coal.Sphere):
        return Prop("sphere", (shape.radius,), color)
    raise ValueError(f"{item.name} is a {type(shape).__name__}: draw it as cylinder, box or sphere")
