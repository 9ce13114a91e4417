"""A first guess of where the block is, from bright patches in the reduced picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from codesign_perception.box import CORNERS, UndistortedImage, placed
from codesign_perception.camera import Floats
from codesign_perception.config import EstimatorConfig
from codesign_perception.edges import Colors, Image

NECK = 6  # px of the reduced picture
YAWS = np.arange(12) * np.pi / 12.0
THRESHOLDS = (0.5, 0.35, 0.65)  # between table and the brightest there is
LIFTS = (0.0, 0.05, 0.10, 0.15, 0.20)  # m above the table
GOOD = 0.75  # overlap at which no further threshold is tried
MAX_GUESSES = 4
MAX_PATCHES = 12  # largest ones looked at, per threshold


@dataclass(frozen=True)
class Guess:
    """A state (7,) as of `box`; how well it covers its patch; colours there."""

    state: Floats
    overlap: float
    colors: Colors


def guesses(image: Image, plane: UndistortedImage, config: EstimatorConfig) -> list[Guess]:
    """The likely places, best first; none may be there."""
    step = config.reduction
    small = np.ascontiguousarray(image[step // 2 :: step, step // 2 :: step])
    # White is bright in every channel; a dark or a coloured table is not.
    blue, green, red = cv2.split(small)
    white = cv2.min(cv2.min(blue, green), red)
    share = np.cumsum(np.bincount(white.ravel(), minlength=256)) / white.size
    table, brightest = (int(np.searchsorted(share, part)) for part in (0.5, 0.998))
    top = max(brightest, table + 2.0 * config.min_contrast)
    if share[int(min(table + config.min_contrast, 255))] >= 1.0:
        return []
    # First patches as they are; then, where none fits, cut at narrow places: things that touch.
    passes = [(threshold, 0) for threshold in THRESHOLDS] + [(THRESHOLDS[0], NECK)]
    found: list[Guess] = []
    for threshold, neck in passes:
        mask = (white > table + threshold * (top - table)).astype(np.uint8)
        for patch in _patches(mask, config.reduction, neck):
            guess = _best_guess(small, mask, patch, plane, config)
            if guess is not None and not _is_known(guess, found):
                found.append(guess)
        if found and max(g.overlap for g in found) > GOOD:
            break
    return sorted(found, key=lambda g: -g.overlap)[:MAX_GUESSES]


@dataclass(frozen=True)
class _Patch:
    left: int
    top: int
    width: int
    height: int
    area: int
    center: Floats
    pixels: NDArray[np.uint8]  # its own mask


def _patches(mask: NDArray[np.uint8], step: int, neck: int) -> list[_Patch]:
    """Connected pixels, the largest first, cut where they are at most `neck` px wide (if any)."""
    kernel = np.ones((neck + 1, neck + 1), dtype=np.uint8)
    cores = np.asarray(cv2.erode(mask, kernel), dtype=np.uint8) if neck else mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(cores, connectivity=4)
    least = max(200 // step**2, 12)
    order = [i for i in np.argsort(-stats[1:, cv2.CC_STAT_AREA]) + 1 if stats[i, 4] >= least]
    found = []
    for i in order[:MAX_PATCHES]:
        left, top, width, height, _ = (int(v) for v in stats[i])
        left, top = max(left - neck, 0), max(top - neck, 0)
        window = (slice(top, top + height + 2 * neck), slice(left, left + width + 2 * neck))
        own = (labels[window] == i).astype(np.uint8)
        if neck:
            own = np.asarray(cv2.dilate(own, kernel), dtype=np.uint8) & mask[window]
        moments = cv2.moments(own, binaryImage=True)
        area = int(moments["m00"])
        center = np.array([moments["m10"], moments["m01"]]) / area + [left, top]
        found.append(_Patch(left, top, own.shape[1], own.shape[0], area, center, own))
    return found


def _best_guess(
    small: Image,
    mask: NDArray[np.uint8],
    patch: _Patch,
    plane: UndistortedImage,
    config: EstimatorConfig,
) -> Guess | None:
    """The height and yaw whose silhouette covers the patch best."""
    best: tuple[float, Floats] | None = None
    for lift in LIFTS:
        if lift > config.max_lift:
            break
        for state, overlap in _turned(patch, plane, config, lift):
            if best is None or overlap > best[0]:
                best = (overlap, state)
        if best is None or not 0.5 < best[0] < 0.8:
            break  # found, or of another shape
    if best is None or best[0] < config.min_overlap:
        return None
    colors = _colors(small, mask, patch)
    if colors.contrast < config.min_contrast:
        return None
    return Guess(best[1], best[0], colors)


def _turned(
    patch: _Patch, plane: UndistortedImage, config: EstimatorConfig, lift: float
) -> list[tuple[Floats, float]]:
    """States at one height and every yaw, centred on the patch, with their overlap."""
    step = config.reduction
    z = config.rest_height + lift
    seen = plane.camera.normalized([patch.center * step + step // 2])
    seen = seen * plane.focal + plane.center
    place = plane.on_plane(seen, z)[0]
    x0, x1, y0, y1 = config.region
    if not (x0 <= place[0] <= x1 and y0 <= place[1] <= y1):
        return []
    # Whatever its yaw, its area is within a third of this.
    first = _outlines(place, config, plane, YAWS[1:2])[0]
    if not 0.5 < patch.area * step**2 / max(cv2.contourArea(first), 1.0) < 1.6:
        return []
    outlines = _outlines(place, config, plane, YAWS)
    # The silhouette's middle is not the picture of the box's: move it onto the patch.
    moments = [cv2.moments(loop) for loop in outlines]
    middles = np.array([[m["m10"], m["m01"]] for m in moments])
    middles /= np.array([max(m["m00"], 1e-6) for m in moments])[:, None]
    shifts = seen - middles
    places = plane.on_plane(seen + shifts, z)
    found = []
    for loop, shift, moved, yaw in zip(outlines, shifts, places, YAWS, strict=True):
        corners = (plane.distorted(loop + shift) - step // 2) / step
        found.append((np.array([*moved, yaw, *config.settled_size]), _overlap(patch, corners)))
    return found


def _outlines(
    place: Floats, config: EstimatorConfig, plane: UndistortedImage, yaws: NDArray[np.floating]
) -> list[NDArray[np.float32]]:
    """Corners of the silhouettes of a block at one place and several yaws, each (N, 2) [px]."""
    states = [np.array([*place, yaw, *config.settled_size]) for yaw in yaws]
    points = np.concatenate([placed(state, CORNERS) for state in states])
    pixels = plane.project(points)[0].astype(np.float32).reshape(len(yaws), len(CORNERS), 2)
    return [np.asarray(cv2.convexHull(corners)[:, 0]) for corners in pixels]


def _overlap(patch: _Patch, corners: Floats) -> float:
    """Intersection over union of the patch and a convex outline, in the reduced picture."""
    low = np.minimum(np.floor(corners.min(axis=0)).astype(int), [patch.left, patch.top]) - 1
    high = np.maximum(
        np.ceil(corners.max(axis=0)).astype(int),
        [patch.left + patch.width, patch.top + patch.height],
    )
    width, height = (high - low + 2).astype(int)
    if width * height > 400_000:
        return 0.0
    drawn = np.zeros((height, width), dtype=np.uint8)
    cv2.fillConvexPoly(drawn, np.round((corners - low) * 16).astype(np.int32), 1, shift=4)
    x, y = patch.left - low[0], patch.top - low[1]
    inside = drawn[y : y + patch.height, x : x + patch.width]
    both = int(cv2.countNonZero(inside & patch.pixels))
    return both / max(int(cv2.countNonZero(drawn)) + patch.area - both, 1)


def _colors(small: Image, mask: NDArray[np.uint8], patch: _Patch) -> Colors:
    """Medians of the patch and of what is dark in a frame around it."""
    rim = max(patch.width, patch.height) // 3 + 3
    top, left = max(patch.top - rim, 0), max(patch.left - rim, 0)
    window = (
        slice(top, patch.top + patch.height + rim),
        slice(left, patch.left + patch.width + rim),
    )
    around = small[window][mask[window] == 0]
    own = small[patch.top : patch.top + patch.height, patch.left : patch.left + patch.width]
    inside = np.median(own[patch.pixels > 0], axis=0)
    outside = np.median(around, axis=0) if len(around) else np.zeros(3)
    return Colors(inside.astype(np.float64), outside.astype(np.float64))


def _is_known(guess: Guess, others: list[Guess]) -> bool:
    """Whether another threshold has led to the same place already."""
    return any(
        np.linalg.norm(guess.state[:3] - other.state[:3]) < 0.004 and other.overlap >= guess.overlap
        for other in others
    )
