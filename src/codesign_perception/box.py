"""A box standing upright: its silhouette in the image and how that moves with its pose.

A state is (7,): x, y, z of the box's centre in link_base [m], the angle of its first edge from the
x axis about z [rad], and its edges' lengths, the last one upright [m]. The image here is the
undistorted plane in pixels of the camera's own focal lengths.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from codesign_perception.camera import Camera

Floats = NDArray[np.float64]

CORNERS = np.array([[sx, sy, sz] for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)]) / 2.0


class UndistortedImage:
    """Projection onto the undistorted plane, and from there into the image as it is."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.rotation = camera.rotation
        self.focal = camera.matrix[[0, 1], [0, 1]]
        self.center = camera.matrix[:2, 2]

    def project(self, points: Floats) -> tuple[Floats, Floats]:
        """(N, 3) points of link_base: pixels (N, 2) and the points in the camera's frame (N, 3)."""
        local = (points - self.camera.position) @ self.rotation
        return local[:, :2] / local[:, 2:] * self.focal + self.center, local

    def on_plane(self, pixels: Floats, height: float) -> Floats:
        """(N, 3) where undistorted pixels (N, 2) meet z = `height`; NaN if they never do."""
        flat = np.ones((len(pixels), 3))
        flat[:, :2] = (pixels - self.center) / self.focal
        directions = flat @ self.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (height - self.camera.position[2]) / directions[:, 2]
        distance[~(distance > 0.0) | ~np.isfinite(distance)] = np.nan
        return self.camera.position + distance[:, None] * directions

    def jacobian(self, local: Floats) -> Floats:
        """(N, 2, 3): motion of the pixels per motion of the points in link_base [px/m]."""
        depth = local[:, 2]
        rows = np.zeros((len(local), 2, 3))
        rows[:, 0, 0] = self.focal[0] / depth
        rows[:, 1, 1] = self.focal[1] / depth
        rows[:, 0, 2] = -self.focal[0] * local[:, 0] / depth**2
        rows[:, 1, 2] = -self.focal[1] * local[:, 1] / depth**2
        return rows @ self.rotation.T

    def distorted(self, pixels: Floats) -> Floats:
        """(..., 2) undistorted pixels where the lens shows them."""
        k1, k2, p1, p2, k3 = self.camera.distortion
        if not self.camera.distortion.any():
            return pixels
        flat = (pixels - self.center) / self.focal
        x, y = flat[..., 0], flat[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent = np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
        return bent * self.focal + self.center


def placed(state: Floats, fractions: Floats) -> Floats:
    """(N, 3) points of link_base [m] at `fractions` (N, 3) of the edges from the centre."""
    c, s = np.cos(state[3]), np.sin(state[3])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    points: Floats = (fractions * state[4:]) @ turn + state[:3]
    return points


def silhouette(state: Floats, image: UndistortedImage) -> tuple[Floats, Floats]:
    """Corners on the outline in order around it: fractions (N, 3) and pixels (N, 2)."""
    pixels, _ = image.project(placed(state, CORNERS))
    loop = cv2.convexHull(pixels.astype(np.float32), returnPoints=False)[:, 0]
    return CORNERS[loop], pixels[loop]


@dataclass(frozen=True)
class Outline:
    """Points along the outline of a box.

    Attributes:
        fractions: (N, 3) of the box's edges, from its centre.
        pixels: (N, 2) where they appear, undistorted.
        normals: (N, 2) unit, outwards.
        edges: (N,) number of the outline's edge that each lies on.
        count: of edges.
    """

    fractions: Floats
    pixels: Floats
    normals: Floats
    edges: NDArray[np.intp]
    count: int


def outline(state: Floats, image: UndistortedImage, spacing: float, margin: float) -> Outline:
    """Points `spacing` px apart on the silhouette, `margin` (a share) away from its corners."""
    corners, pixels = silhouette(state, image)
    following = np.roll(pixels, -1, axis=0)
    lengths = np.linalg.norm(following - pixels, axis=1)
    counts = np.maximum((lengths * (1.0 - 2.0 * margin) / spacing).astype(int), 1)
    counts[lengths < 4.0 * spacing * margin + 4.0] = 0  # a face seen edge-on
    edges = np.repeat(np.arange(len(corners)), counts)
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    share = (np.arange(len(edges)) - starts[edges] + 0.5) / counts[edges]
    share = (margin + (1.0 - 2.0 * margin) * share)[:, None]
    fractions = corners[edges] * (1.0 - share) + np.roll(corners, -1, axis=0)[edges] * share
    along = (following - pixels) / np.maximum(lengths, 1e-9)[:, None]
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    center = pixels.mean(axis=0)
    normals *= np.sign(((pixels - center) * normals).sum(axis=1))[:, None]
    places, _ = image.project(placed(state, fractions))
    return Outline(fractions, places, normals[edges], edges, len(corners))


def offsets_and_jacobian(
    state: Floats, image: UndistortedImage, line: Outline
) -> tuple[Floats, Floats]:
    """How a state moves an outline's points along its normals.

    Returns:
        (N,) offset from `line.pixels` [px]; (N, 7) its derivatives by the state [px/m, px/rad].
    """
    points = placed(state, line.fractions)
    pixels, local = image.project(points)
    by_point = np.einsum("nk,nkj->nj", line.normals, image.jacobian(local))
    arm = points - state[:3]
    by_yaw = -by_point[:, 0] * arm[:, 1] + by_point[:, 1] * arm[:, 0]
    c, s = np.cos(state[3]), np.sin(state[3])
    along = np.column_stack(
        [
            by_point[:, 0] * c + by_point[:, 1] * s,
            by_point[:, 1] * c - by_point[:, 0] * s,
            by_point[:, 2],
        ]
    )
    offset = ((pixels - line.pixels) * line.normals).sum(axis=1)
    return offset, np.column_stack([by_point, by_yaw, along * line.fractions])
