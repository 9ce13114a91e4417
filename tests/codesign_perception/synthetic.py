"""Pictures of a box on a table, drawn as exactly as anti-aliasing allows: known answers."""

import cv2
import numpy as np

from codesign_perception.camera import Camera

SUPER = 8
TOFU = np.array([219, 240, 247], dtype=np.float64)  # BGR
TABLE = np.array([78, 66, 60], dtype=np.float64)
SIGNS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
# Faces as corner loops, with outward normals, and how much light they get.
FACES = [
    ([4, 5, 7, 6], (1, 0, 0), 0.78),
    ([0, 1, 3, 2], (-1, 0, 0), 0.72),
    ([2, 3, 7, 6], (0, 1, 0), 0.66),
    ([0, 1, 5, 4], (0, -1, 0), 0.85),
    ([1, 3, 7, 5], (0, 0, 1), 1.0),
]


def blank(camera: Camera, table: np.ndarray = TABLE) -> np.ndarray:
    """An empty table, (height, width, 3) floats."""
    return np.broadcast_to(table.astype(np.float32), (camera.height, camera.width, 3)).copy()


def draw_polygon(image: np.ndarray, camera: Camera, loop: np.ndarray, color: np.ndarray) -> None:
    """Fills a loop of (N, 3) points of link_base, its edges cut up for the lens's bending."""
    share = np.linspace(0.0, 1.0, 16, endpoint=False)[:, None]
    points = np.concatenate(
        [a * (1 - share) + b * share for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True)]
    )
    pixels = camera.project(points)
    low = np.maximum(np.floor(pixels.min(axis=0)).astype(int) - 2, 0)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 3, (camera.width, camera.height))
    if (high <= low).any():
        return
    width, height = high - low
    fine = np.zeros((height * SUPER, width * SUPER), dtype=np.uint8)
    # The centre of pixel 0 is SUPER / 2 - 0.5 in the fine picture.
    scaled = (pixels - low + 0.5) * SUPER - 0.5
    loop_px = np.round(scaled * 256).astype(np.int32)
    cv2.fillPoly(fine, [loop_px], 255, shift=8)
    # fillPoly draws all pixels that the border touches: half of each is inside.
    cv2.polylines(fine, [loop_px], True, 128, shift=8)
    cover = cv2.resize(fine, (int(width), int(height)), interpolation=cv2.INTER_AREA)
    cover = cover.astype(np.float32) / 255.0
    part = image[low[1] : high[1], low[0] : high[0]]
    part += cover[..., None] * (color.astype(np.float32) - part)


def draw_box(
    image: np.ndarray,
    camera: Camera,
    pose: np.ndarray,
    size: tuple[float, float, float] = (0.05, 0.03, 0.04),
    color: np.ndarray = TOFU,
) -> None:
    """A box at (x, y, z of its centre, yaw)."""
    c, s = np.cos(pose[3]), np.sin(pose[3])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    corners = (SIGNS * size) @ turn.T + pose[:3]
    for loop, normal, light in FACES:
        middle = corners[loop].mean(axis=0)
        if (turn @ np.array(normal, float)) @ (camera.position - middle) > 0.0:
            draw_polygon(image, camera, corners[loop], color * light)


def finished(
    image: np.ndarray,
    rng: np.random.Generator,
    *,
    blur: float = 0.0,
    noise: float = 0.0,
    light: float = 1.0,
) -> np.ndarray:
    """Light, blur [px], noise [grey levels], rounded to 8 bits."""  # fmt: skip
    image = image * np.float32(light)
    if blur:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    if noise:
        image += np.float32(noise) * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def tofu_image(camera: Camera, pose: np.ndarray, **kwargs: float) -> np.ndarray:
    """A box alone on the table."""
    image = blank(camera)
    draw_box(image, camera, np.asarray(pose, dtype=np.float64))
    return finished(image, np.random.default_rng(0), **kwargs)
