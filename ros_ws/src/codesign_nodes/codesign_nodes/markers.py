"""Markers of the scene for RViz, Foxglove and Lichtblick.

A message of thousands of Point and ColorRGBA objects costs tens of milliseconds in Python. The
layout of the message stays the same from picture to picture, so it is serialised once and the
numbers are written into the bytes: a publisher takes serialised messages as they are.
"""

from typing import Any

import numpy as np
from geometry_msgs.msg import Point, Pose
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from codesign_design.finger_pair import FingerPair, TriangleMesh

STRESS_FULL_SCALE = 2000.0  # Pa, the darkest colour
# Numbers that mark the places in the serialised message; no real coordinate is one of them.
_POINTS, _LEFT, _RIGHT = 12345.678901, 23456.789012, 34567.890123


class SceneMarkers:
    """MarkerArray with the tofu's surface coloured by von Mises stress, both fingers, the table.

    Args:
        triangles: surface of the tofu, (S, 3) node indices.
        tetrahedra: (S,) tetrahedron behind each triangle.
        fingers: the pair in use.
        table_height: z of the table in link_base [m].
    """

    def __init__(
        self,
        triangles: NDArray[np.int32],
        tetrahedra: NDArray[np.int32],
        fingers: FingerPair,
        table_height: float,
    ) -> None:
        self._corners = triangles.reshape(-1)
        self._corner_tetrahedra = np.repeat(tetrahedra, 3)
        count = len(self._corners)
        tofu = _marker("tofu", Marker.TRIANGLE_LIST)
        tofu.points = [Point(x=_POINTS)] + [Point()] * (count - 1)
        tofu.colors = [ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)] * count
        left = _finger_marker("left_finger", fingers.left, _LEFT)
        right = _finger_marker("right_finger", fingers.right, _RIGHT)
        array = MarkerArray(markers=[tofu, left, right, _table_marker(table_height)])
        self._bytes = bytearray(serialize_message(array))
        start = self._find(_POINTS)
        self._points = self._view("<f8", 3 * count, start)
        # The colours follow the points: their count (uint32), then 4 float32 each.
        self._colors = self._view("<f4", 4 * count, start + 24 * count + 4)
        if not np.all(self._colors == 1.0):
            raise RuntimeError("the serialised MarkerArray is not laid out as expected")
        self._left, self._right = (self._view("<f8", 7, self._find(v)) for v in (_LEFT, _RIGHT))

    def _find(self, sentinel: float) -> int:
        return self._bytes.index(np.float64(sentinel).tobytes())

    def _view(self, kind: str, count: int, start: int) -> NDArray[Any]:
        return np.frombuffer(self._bytes, kind, count, start)

    def serialized(
        self, positions: NDArray[Any], von_mises: NDArray[Any], left: Pose, right: Pose
    ) -> bytes:
        """The message for node positions (N, 3) [m], stresses (T,) [Pa] and finger poses."""
        self._points[:] = positions[self._corners].reshape(-1)
        level = np.clip(von_mises[self._corner_tetrahedra] / STRESS_FULL_SCALE, 0.0, 1.0)
        self._colors.reshape(-1, 4)[:, :3] = stress_colors(level)
        self._left[:], self._right[:] = _pose_numbers(left), _pose_numbers(right)
        return bytes(self._bytes)


def stress_colors(level: NDArray[Any]) -> NDArray[np.float64]:
    """Colours (K, 3) from tofu white over yellow to dark red for levels (K,) in 0..1."""
    stops = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    colors = np.array(
        [
            [0.93, 0.93, 0.88],
            [0.98, 0.85, 0.45],
            [0.96, 0.55, 0.24],
            [0.82, 0.20, 0.20],
            [0.40, 0.00, 0.20],
        ]
    )
    return np.column_stack([np.interp(level, stops, colors[:, k]) for k in range(3)])


def _pose_numbers(pose: Pose) -> list[float]:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def _finger_marker(name: str, mesh: TriangleMesh, sentinel: float) -> Marker:
    marker = _marker(name, Marker.TRIANGLE_LIST)
    marker.pose.position.x = sentinel
    marker.color = ColorRGBA(r=0.35, g=0.38, b=0.42, a=1.0)
    corners = mesh.vertices[mesh.faces.reshape(-1)].tolist()
    marker.points = [Point(x=x, y=y, z=z) for x, y, z in corners]
    return marker


def _table_marker(height: float) -> Marker:
    table = _marker("table", Marker.CUBE)
    table.pose.position.x, table.pose.position.z = 0.45, height - 0.005
    table.scale.x, table.scale.y, table.scale.z = 0.4, 0.6, 0.01
    table.color = ColorRGBA(r=0.75, g=0.72, b=0.68, a=1.0)
    return table


def _marker(namespace: str, kind: int) -> Marker:
    # Stamp 0 means "now" to viewers; lifetime 0 means until replaced.
    marker = Marker(ns=namespace, id=0, type=kind, action=Marker.ADD)
    marker.header.frame_id = "link_base"
    marker.scale.x = marker.scale.y = marker.scale.z = 1.0
    return marker
