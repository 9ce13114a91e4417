"""The picture with what was found in it drawn over it."""

from __future__ import annotations

import cv2
import numpy as np

from codesign_perception.edges import Image
from codesign_perception.tofu_pose import Detection

GREEN, RED = (80, 220, 60), (60, 60, 240)


def debug_picture(image: Image, detection: Detection, width: int = 640) -> Image:
    """A smaller copy with the block's outline, or the reason why there is none."""
    picture = image.copy()
    pose = detection.pose
    if pose is not None:
        corners = np.round(pose.outline * 16.0).astype(np.int32)
        cv2.polylines(picture, [corners], True, GREEN, 2, cv2.LINE_AA, 4)
    scale = width / image.shape[1]
    size = (width, round(image.shape[0] * scale))
    picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    if pose is None:
        text, color = detection.reason, RED
    else:
        x, y, z = 1e3 * pose.position
        text = f"{x:.1f} {y:.1f} {z:.1f} mm, {np.degrees(pose.yaw):.1f} deg, {pose.state}"
        text, color = f"{text}, score {detection.score:.2f}", GREEN
    cv2.putText(
        picture, text, (8, size[1] - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv2.LINE_AA
    )
    return np.asarray(picture, dtype=np.uint8)
