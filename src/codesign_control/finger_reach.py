"""How low a pair of fingers reaches, whatever way the tool is turned."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from codesign_control.pose import Pose


class FingerReach:
    """The corners of both fingers' convex hulls, in the grasp frame at gap 0."""

    def __init__(self, left: np.ndarray, right: np.ndarray) -> None:
        """Args: vertices of the fingers, (V, 3) each [m]; the left one opens along +y."""
        self._corners = [points[ConvexHull(points).vertices] for points in (left, right)]

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) m: corners of the left and of the right finger's hull."""
        return self._corners[0], self._corners[1]

    def lowest(self, grasp: Pose, width: float) -> float:
        """z of the lowest point in `link_base` [m], for a pose of the grasp frame and a gap [m]."""
        down = grasp.rotation[2]
        sides = zip(self._corners, (0.5, -0.5), strict=True)
        lowest = min(float((c @ down).min()) + side * width * down[1] for c, side in sides)
        return float(grasp.position[2]) + lowest
