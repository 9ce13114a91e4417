"""The pose of a block of known size in one picture, or the reason why there is none.

A search in the reduced picture gives first guesses; each is refined on some hundred edge points
that are measured to a fraction of a pixel along the normals of the block's outline. Points that
are hidden, or whose inside does not look like the block, do not count; what agrees in the end is
the score.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from codesign_perception.box import Box, UndistortedImage, offsets_and_jacobian, outline
from codesign_perception.camera import Camera, Floats
from codesign_perception.config import EstimatorConfig
from codesign_perception.edges import Colors, Image, strongest_edges, subpixel_edges
from codesign_perception.search import Guess, guesses

CORNER_MARGIN = 0.08  # share of an edge near its corners that is left out: corners are round
WIDE, MIDDLE, NARROW = 12.0, 6.0, 3.0  # px that edges are looked for in
GOOD = 0.85  # score at which no further guess is tried
RELEASED_SIGMA = 0.25  # m, of a height of which nothing is known
REST_MARGIN = 0.1  # px^2: by how much a free height must fit better before the block counts as up


@dataclass(frozen=True)
class HeightPrior:
    """What is known of the height of the block's centre: z and its standard deviation [m]."""

    z: float
    sigma: float


@dataclass(frozen=True)
class TofuPose:
    """Where the block is.

    Attributes:
        position: (3,) of the block's centre in link_base [m].
        yaw: of its long side from the x axis of link_base, in [-pi / 2, pi / 2) [rad]: a half turn
            cannot be seen.
        covariance: (4, 4) of x, y, z [m^2] and yaw [rad^2], without the camera's own error.
        score: share of the outline that agrees with the picture, 0 to 1.
        rms: of the points that agree [px].
        resting: whether it stands on the table.
        outline: (N, 2) corners of the silhouette in the picture [px].
        colors: of block and surroundings.
    """

    position: Floats
    yaw: float
    covariance: Floats
    score: float
    rms: float
    resting: bool
    outline: Floats
    colors: Colors = field(repr=False)

    @property
    def quaternion(self) -> Floats:
        """(4,) x y z w of the block's frame in link_base."""
        return np.array([0.0, 0.0, np.sin(self.yaw / 2.0), np.cos(self.yaw / 2.0)])


@dataclass(frozen=True)
class Detection:
    """What came of one picture: a pose, or None and why; `score` of the best attempt."""

    pose: TofuPose | None
    reason: str
    score: float = 0.0


@dataclass(frozen=True)
class _Fit:
    pose: Floats
    covariance: Floats
    score: float
    rms: float
    edges: int
    colors: Colors


class TofuPoseEstimator:
    """Finds the block in BGR pictures of one camera. Not for several threads at once.

    Args:
        camera: calibrated, with its place in link_base.
        config: the block and what is believed.
    """

    def __init__(self, camera: Camera, config: EstimatorConfig | None = None) -> None:
        self.config = config or EstimatorConfig()
        self.camera = camera
        self._plane = UndistortedImage(camera)
        self._box = Box(self.config.settled_size)
        self._last: TofuPose | None = None

    def reset(self) -> None:
        """Forget where the block was."""
        self._last = None

    def estimate(self, image: Image, height: HeightPrior | None = None) -> Detection:
        """The block's pose in a picture.

        It is looked for where the last picture had it, and everywhere if it is not there.

        Args:
            image: (height, width, 3) BGR, of the camera's size.
            height: what is known of the height, such as from the hand that holds the block; None:
                it may rest on the table or be anywhere above it.

        Raises:
            ValueError: a picture of another size or type.
        """
        shape = (self.camera.height, self.camera.width, 3)
        if image.shape != shape or image.dtype != np.uint8:
            raise ValueError(
                f"image is {image.shape} {image.dtype}: the camera's are {shape} uint8 (BGR)"
            )
        best = self._followed(image, height)
        if best is None or not self._is_believed(best):
            best = self._searched(image, height, best)
        return self._judged(best)

    # -- attempts

    def _followed(self, image: Image, height: HeightPrior | None) -> _Fit | None:
        """From where it was last."""
        if self._last is None:
            return None
        start = np.array([*self._last.position, self._last.yaw])
        return self._refined(image, Guess(start, 1.0, self._last.colors), height, wide=False)

    def _searched(self, image: Image, height: HeightPrior | None, best: _Fit | None) -> _Fit | None:
        """From the whole picture."""
        for guess in guesses(image, self._plane, self.config, self._box):
            fit = self._refined(image, guess, height, wide=True)
            if fit is not None and (best is None or _rank(fit) > _rank(best)):
                best = fit
            if best is not None and best.score > GOOD and self._is_believed(best):
                break
        return best

    def _refined(
        self, image: Image, guess: Guess, height: HeightPrior | None, *, wide: bool
    ) -> _Fit | None:
        """The best fit near a guess: at the prior's height, at rest, or wherever it fits."""
        rest = HeightPrior(self.config.rest_height, self.config.rest_sigma)
        free = HeightPrior(float(guess.pose[2]), RELEASED_SIGMA)
        if height is not None:
            known = self._fit(image, guess, height, wide)
            if known is not None and self._is_believed(known):
                return known
        resting = self._fit(image, guess, rest, wide)
        if resting is not None and resting.score > GOOD and resting.rms**2 < REST_MARGIN:
            return resting
        lifted = self._fit(image, guess, free, wide)
        if lifted is None or lifted.pose[2] < rest.z + 0.002:
            return resting
        if resting is None:
            return lifted
        gain = _misfit(resting, self.config) - _misfit(lifted, self.config)
        return lifted if gain > REST_MARGIN else resting

    # -- one fit

    def _fit(self, image: Image, guess: Guess, prior: HeightPrior, wide: bool) -> _Fit | None:
        """Gauss-Newton on edge points, measured again as the outline moves."""
        pose = guess.pose.copy()
        if prior.sigma < 0.01:
            pose = self._along_ray(pose, prior.z)
        colors = guess.colors
        for reach in (WIDE, WIDE) if wide else (WIDE,):
            line = outline(self._box, pose, self._plane, 2.0 * self.config.spacing, CORNER_MARGIN)
            found = strongest_edges(image, self._plane, line, reach, colors)
            step = self._solved(pose, line, found.offsets, found.found, prior)
            if step is None:
                return None
            pose = step[0]
        result = None
        for reach in (MIDDLE, NARROW, NARROW):
            line = outline(self._box, pose, self._plane, self.config.spacing, CORNER_MARGIN)
            found = subpixel_edges(image, self._plane, line, reach, colors)
            step = self._solved(pose, line, found.offsets, found.found, prior)
            if step is None:
                return None
            pose = step[0]
            result = step[1:], line, found
        assert result is not None
        (covariance, residuals), line, found = result
        agree = found.found & (np.abs(residuals) < self.config.max_residual)
        rms = float(np.sqrt(np.mean(residuals[agree] ** 2))) if agree.any() else np.inf
        sides = np.bincount(line.edges[agree], minlength=line.count)
        total = np.bincount(line.edges, minlength=line.count)
        edges = int((sides > 0.4 * np.maximum(total, 1)).sum())
        return _Fit(pose, covariance, float(agree.mean()), rms, edges, colors)

    def _along_ray(self, pose: Floats, z: float) -> Floats:
        """The pose at another height that appears at the same place."""
        pixel = self.camera.project([pose[:3]])
        place = self.camera.on_plane(pixel, z)[0]
        return pose if np.isnan(place).any() else np.array([place[0], place[1], z, pose[3]])

    def _solved(
        self, pose: Floats, line: object, offsets: Floats, found: Floats, prior: HeightPrior
    ) -> tuple[Floats, Floats, Floats] | None:
        """The pose that the edge points and the height speak for.

        Returns:
            pose (4,), covariance (4, 4), residuals (N,) [px]; None if the points fix no pose.
        """
        config = self.config
        if found.sum() < 12:
            return None
        scale = np.array([1e-3, 1e-3, 1e-3, 1e-2])  # mm, centiradians: a well-scaled problem
        height_weight = (scale[2] / prior.sigma) ** 2
        normal = np.eye(4)
        residuals = sigma = None
        for _ in range(6):
            moved, jacobian = offsets_and_jacobian(self._box, pose, self._plane, line)
            residuals = offsets - moved
            jacobian = jacobian * scale
            spread = 1.4826 * np.median(np.abs(residuals[found]))
            cut = max(4.7 * spread, config.max_residual)
            weight = np.where(found, np.maximum(1.0 - (residuals / cut) ** 2, 0.0) ** 2, 0.0)
            sigma = max(spread, config.noise_floor)
            weight /= sigma**2 * config.correlation
            normal = jacobian.T @ (weight[:, None] * jacobian)
            normal[2, 2] += height_weight
            right = jacobian.T @ (weight * residuals)
            right[2] += height_weight * (prior.z - pose[2]) / scale[2]
            try:
                step = np.linalg.solve(normal, right)
            except np.linalg.LinAlgError:
                return None
            length = float(np.abs(step).max())
            if not np.isfinite(length):
                return None
            pose = pose + scale * step * min(1.0, 20.0 / max(length, 1e-9))
            if length < 0.005:
                break
        moved, _ = offsets_and_jacobian(self._box, pose, self._plane, line)
        try:
            covariance = scale[:, None] * np.linalg.inv(normal) * scale
        except np.linalg.LinAlgError:
            return None
        return pose, covariance, offsets - moved

    # -- judgement

    def _is_believed(self, fit: _Fit) -> bool:
        return not self._objection(fit)

    def _objection(self, fit: _Fit) -> str:
        """Why a fit is not the block; empty if nothing speaks against it."""
        config = self.config
        x, y, z, _ = fit.pose
        x0, x1, y0, y1 = config.region
        deviation = float(np.sqrt(np.diag(fit.covariance)[:2].max()))
        if fit.score < config.min_score:
            return (
                f"only {fit.score:.0%} of the outline agrees with the picture, at least "
                f"{config.min_score:.0%} must: block hidden, of another size, or camera moved"
            )
        if fit.edges < 3:
            return f"only {fit.edges} edges of the outline are visible, at least 3 must be"
        if fit.rms > config.max_rms:
            return f"outline is off by {fit.rms:.2f} px rms, at most {config.max_rms:.2f}"
        if not (x0 <= x <= x1 and y0 <= y <= y1):
            return f"block at x {x:.3f}, y {y:.3f} m: outside the region {config.region}"
        if not -0.005 <= z - config.rest_height <= config.max_lift:
            return f"block at height {z:.3f} m: not between the table and {config.max_lift} m above"
        if deviation > config.max_sigma:
            return (
                f"place is uncertain by {1e3 * deviation:.1f} mm, at most "
                f"{1e3 * config.max_sigma:.1f}: too little of the outline is visible"
            )
        return ""

    def _judged(self, fit: _Fit | None) -> Detection:
        if fit is None:
            self._last = None
            return Detection(None, "nothing as bright and as large as the block in its region")
        objection = self._objection(fit)
        if objection:
            self._last = None
            return Detection(None, objection, fit.score)
        resting = abs(fit.pose[2] - self.config.rest_height) < 0.002
        corners = self._box.placed(fit.pose)[self._box.silhouette(fit.pose, self._plane)]
        self._last = TofuPose(
            position=fit.pose[:3].copy(),
            yaw=wrapped(float(fit.pose[3])),
            covariance=fit.covariance,
            score=fit.score,
            rms=fit.rms,
            resting=resting,
            outline=self.camera.project(corners),
            colors=fit.colors,
        )
        return Detection(self._last, "", fit.score)


def wrapped(yaw: float) -> float:
    """A yaw in [-pi / 2, pi / 2): a box looks the same after a half turn [rad]."""
    return (yaw + np.pi / 2.0) % np.pi - np.pi / 2.0


def _rank(fit: _Fit) -> float:
    return fit.score - 0.2 * min(fit.rms, 2.0)


def _misfit(fit: _Fit, config: EstimatorConfig) -> float:
    """Mean square distance of all points, missing ones at the limit [px^2]."""
    return fit.score * fit.rms**2 + (1.0 - fit.score) * config.max_residual**2
