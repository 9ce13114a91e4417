"""Markers of the scene for RViz, Foxglove and Lichtblick.

A message of thousands of Point and ColorRGBA objects costs tens of milliseconds in Python. The
layout of the message stays the same from picture to picture, so it is serialised once and the
numbers are written into the bytes: a publisher takes serialised messages as they are.
"""

from typing import Any

import numpy as np
from codesign_design.finger_pair import FingerPair
from geometry_msgs.msg import Point, Pose
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

STRESS_FULL_SCALE = 2000.0  # Pa, the reddest colour
_SENTINEL = 12345.678901


class SurfaceMarkers:
    """MarkerArray with the tofu's surface coloured by von Mises stress.

    Args:
        triangles: (S, 3) node indices.
        tetrahedra: (S,) tetrahedron behind each triangle.
    """

    def __init__(self, triangles: NDArray[np.int32], tetrahedra: NDArray[np.int32]) -> None:
        self._corners = triangles.reshape(-1)
        self._corner_tetrahedra = np.repeat(tetrahedra, 3)
        corners = len(self._corners)
        marker = _marker("tofu", Marker.TRIANGLE_LIST, Pose())
        marker.scale.x = marker.scale.y = marker.scale.z = 1.0
        marker.points = [Point(x=_SENTINEL)] + [Point()] * (corners - 1)
        marker.colors = [ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)] * corners
        self._bytes = bytearray(serialize_message(MarkerArray(markers=[marker])))
        start = self._bytes.index(np.float64(_SENTINEL).tobytes())
        points_end = start + 24 * corners
        # The colours follow: their count (uint32), then 4 float32 each.
        self._points = np.frombuffer(self._bytes, "<f8", 3 * corners, start)
        self._colors = np.frombuffer(self._bytes, "<f4", 4 * corners, points_end + 4)
        count = int(np.frombuffer(self._bytes, "<u4", 1, points_end)[0])
        if count != corners or not np.all(self._colors == 1.0):
            raise RuntimeError("the serialised MarkerArray is not laid out as expected")

    def serialized(self, positions: NDArray[Any], von_mises: NDArray[Any]) -> bytes:
        """The message for node positions (N, 3) [m] and stresses (T,) [Pa]."""
        self._points[:] = positions[self._corners].reshape(-1)
        level = np.clip(von_mises[self._corner_tetrahedra] / STRESS_FULL_SCALE, 0.0, 1.0)
        self._colors.reshape(-1, 4)[:, :3] = stress_colors(level)
        return bytes(self._bytes)


def stress_colors(level: NDArray[Any]) -> NDArray[np.float64]:
    """Colours (K, 3) from tofu white over yellow to red for levels (K,) in 0..1."""
    stops = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    colors = np.array(
        [[0.93, 0.93, 0.88], [0.98, 0.85, 0.45], [0.96, 0.55, 0.24], [0.82, 0.20, 0.20], [0.4, 0, 0.2]]
    )
    return np.column_stack([np.interp(level, stops, colors[:, k]) for k in range(3)])


def scene_markers(fingers: FingerPair, left: Pose, right: Pose, table_height: float) -> MarkerArray:
    """Fingers as mesh triangles at their poses, and the table."""
    markers = []
    for name, mesh, pose in (("left_finger", fingers.left, left), ("right_finger", fingers.right, right)):
        marker = _marker(name, Marker.TRIANGLE_LIST, pose)
        marker.scale.x = marker.scale.y = marker.scale.z = 1.0
        marker.color = ColorRGBA(r=0.35, g=0.38, b=0.42, a=1.0)
        corners = mesh.vertices[mesh.faces.reshape(-1)].tolist()
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in corners]
        markers.append(marker)
    table = _marker("table", Marker.CUBE, Pose())
    table.pose.position.x, table.pose.position.z = 0.45, table_height - 0.005
    table.scale.x, table.scale.y, table.scale.z = 0.4, 0.6, 0.01
    table.color = ColorRGBA(r=0.75, g=0.72, b=0.68, a=1.0)
    return MarkerArray(markers=[*markers, table])


def _marker(namespace: str, kind: int, pose: Pose) -> Marker:
    # Stamp 0 means "now" to viewers; lifetime 0 means until replaced.
    marker = Marker(ns=namespace, id=0, type=kind, action=Marker.ADD, pose=pose)
    marker.header.frame_id = "link_base"
    return marker
