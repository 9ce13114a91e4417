"""A picture of a finger pair around the object, both as they are before they touch."""

from io import BytesIO

import numpy as np
from PIL import Image as Picture

from codesign_report.recording import TrialRecording
from codesign_report.scene import FINGER_COLOR, Camera, Look, SceneRenderer

SOLID = (*FINGER_COLOR[:3], 1.0)
VIEW_HEIGHT = 0.078  # m, of the picture at the object
DISTANCE = 0.6  # m, from the camera to the object
ROOM = 0.012  # m, between the object and each finger's most protruding point
AZIMUTH, ELEVATION = np.radians(74.0), np.radians(10.0)  # off the opening direction; up


def finger_portrait(trial: TrialRecording, width: int = 800, height: int = 460) -> bytes:
    """The fingers opened on both sides of the object at rest, JPEG.

    Raises:
        RuntimeError: no offscreen OpenGL.
    """
    nodes = trial.motion.positions[0].astype(np.float64)
    table, centre = float(nodes[:, 2].min()), nodes.mean(axis=0)
    tips = max(float(m.vertices[:, 2].max()) for m in (trial.left_finger, trial.right_finger))
    half = np.ptp(nodes[:, 1]) / 2.0 + ROOM
    # The tool points down, turned about x: its left finger is on the side of negative y.
    left, right = (
        np.array([centre[0], centre[1] + side * half, table + tips, 1.0, 0.0, 0.0, 0.0])
        for side in (-1.0, 1.0)
    )
    away = [
        np.cos(ELEVATION) * np.sin(AZIMUTH),
        np.cos(ELEVATION) * np.cos(AZIMUTH),
        np.sin(ELEVATION),
    ]
    target = centre + np.array([0.0, 0.0, 0.009])
    with SceneRenderer(
        trial.soft_body,
        (trial.left_finger, trial.right_finger),
        width,
        height,
        table_height=table,
        center=(float(centre[0]), float(centre[1])),
        look=Look(finger=SOLID),
    ) as renderer:
        renderer.camera = Camera.look_at(
            target + DISTANCE * np.array(away),
            target,
            fovy=2.0 * np.arctan(VIEW_HEIGHT / 2.0 / DISTANCE),
        )
        picture = renderer.render(nodes, None, left, right)
    jpeg = BytesIO()
    Picture.fromarray(picture).save(jpeg, "JPEG", quality=85)
    return jpeg.getvalue()
