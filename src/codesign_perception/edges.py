"""Where the picture's edges lie along the normals of an outline."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from codesign_perception.box import Outline, UndistortedImage
from codesign_perception.camera import Floats

Image = NDArray[np.uint8]

STEP = 0.5  # px between samples
LEVEL = 3.0  # px at either end of a profile that tell what is inside and outside
HUE = 0.22  # sine of the angle to the table's colour within which another one is the table's too
SHADE = (0.45, 1.3)  # brightness of the table in a shadow and in the light
DOUBT = (
    0.05  # weight of an edge against something other than the table: it may hide the block's own
)
MARGIN = 1.5  # px around the edge itself that belong to neither


@dataclass(frozen=True)
class Colors:
    """Mean colours of block and table, (3,) each, BGR."""

    inside: Floats
    outside: Floats

    @property
    def contrast(self) -> float:
        """Their distance [grey levels]."""
        return float(np.linalg.norm(self.inside - self.outside))

    def like_table(self, colors: Floats) -> NDArray[np.bool_]:
        """Which of the (N, 3) colours are the table's, in the light or in a shadow."""
        length = float(np.linalg.norm(self.outside))
        along = colors @ self.outside / max(length, 1e-6)
        across = np.linalg.norm(colors - np.outer(along, self.outside / max(length, 1e-6)), axis=1)
        shade = along / max(length, 1e-6)
        return (across < HUE * along + 3.0) & (shade > SHADE[0]) & (shade < SHADE[1])

    def share(self, colors: Floats) -> Floats:
        """(..., 3) colours: 1 like the block, 0 like the table."""
        axis = (self.inside - self.outside) / max(self.contrast, 1e-6) ** 2
        return (colors - self.outside) @ axis


@dataclass(frozen=True)
class EdgePoints:
    """Per point of an outline.

    Attributes:
        offsets: (N,) of the picture's edge along the normal [px].
        found: (N,) whether there is an edge that leads from block to something else.
        denied: (N,) whether the block cannot end here: it goes on, or only the table is seen.
            Where neither is true something hides the block.
        trust: (N,) weight, 1 for an edge against the table.
    """

    offsets: Floats
    found: NDArray[np.bool_]
    denied: NDArray[np.bool_]
    trust: Floats


def sample(image: Image, plane: UndistortedImage, line: Outline, places: Floats) -> Floats:
    """Colours (N, T, 3) at `places` (T,) px along the normals; NaN outside the picture."""
    grid = line.pixels[:, None] + places[None, :, None] * line.normals[:, None]
    grid = plane.distorted(grid)
    height, width = image.shape[:2]
    low = np.clip(np.floor(grid.min(axis=(0, 1))).astype(int), 0, [width - 1, height - 1])
    high = np.clip(np.ceil(grid.max(axis=(0, 1))).astype(int) + 2, 1, [width, height])
    part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    local = (grid - low).astype(np.float32)
    colors = cv2.remap(
        part, local[..., 0], local[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float64)
    outside = (grid < 0.0).any(axis=2) | (grid > [width - 1, height - 1]).any(axis=2)
    colors[outside] = np.nan
    return colors


def strongest_edges(
    image: Image, plane: UndistortedImage, line: Outline, reach: float, colors: Colors
) -> EdgePoints:
    """The steepest fall from block to table within `reach` px, to a pixel or so."""
    places = np.arange(-reach - 2.0, reach + 2.01, 1.0)
    profile = sample(image, plane, line, places)
    share = colors.share(profile)
    fall = share[:, :-2] - share[:, 2:]
    fall = np.where(np.isnan(fall), -1.0, fall)
    best = fall.argmax(axis=1)
    rows = np.arange(len(best))
    inside = share[rows, np.maximum(best - 1, 0)]
    found = (fall[rows, best] > 0.2) & (inside > 0.35)
    beyond = profile[rows, np.minimum(best + 4, len(places) - 1)]
    return EdgePoints(
        places[1:-1][best], found, np.zeros(len(best), dtype=bool), _trust(beyond, colors)
    )


def subpixel_edges(
    image: Image, plane: UndistortedImage, line: Outline, reach: float, colors: Colors
) -> EdgePoints:
    """Where the picture is half way between what is inside and outside, within `reach` px.

    Levels are each profile's own, so that shading, shadows and neighbours shift nothing.
    """
    end = reach + MARGIN + LEVEL
    places = np.arange(-end, end + STEP / 2.0, STEP)
    profile = sample(image, plane, line, places)
    inner = profile[:, places <= -end + LEVEL].mean(axis=1)
    outer = profile[:, places >= end - LEVEL].mean(axis=1)
    axis = inner - outer
    contrast = np.linalg.norm(axis, axis=1)
    axis = axis / np.maximum(contrast, 1e-6)[:, None] ** 2
    share = np.einsum("ntk,nk->nt", profile - outer[:, None], axis)
    offsets, crossings = _crossings(share, places)
    # What is inside must look like the block and what is outside must not.
    inside, beyond = colors.share(inner), colors.share(outer)
    with np.errstate(invalid="ignore"):
        found = (
            (inside > 0.4) & (inside < 3.0) & (inside - beyond > 0.3)
            & (np.abs(offsets) <= reach + MARGIN) & (crossings <= 3)
        )  # fmt: skip
        goes_on = (inside > 0.4) & (beyond > 0.4) & (np.abs(inside - beyond) < 0.2)
        empty = (inside < 0.3) & colors.like_table(inner)
    denied = (goes_on | empty) & ~found
    return EdgePoints(np.nan_to_num(offsets), found, denied, _trust(outer, colors))


def _trust(beyond: Floats, colors: Colors) -> Floats:
    """(N,) weights of edges by the colours (N, 3) beyond them."""
    with np.errstate(invalid="ignore"):
        return np.where(colors.like_table(beyond), 1.0, DOUBT)


def _crossings(share: Floats, places: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Where rows (N, T) fall through a half, nearest to the middle, and how often they cross."""
    above = share > 0.5
    falls = above[:, :-1] & ~above[:, 1:]
    count = (above[:, :-1] != above[:, 1:]).sum(axis=1)
    before, after = share[:, :-1], share[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        where = places[:-1] + STEP * (before - 0.5) / (before - after)
    where = np.where(falls, where, np.inf)
    nearest = np.abs(where).argmin(axis=1)
    offsets = where[np.arange(len(where)), nearest]
    return np.where(np.isfinite(offsets), offsets, np.nan), count
