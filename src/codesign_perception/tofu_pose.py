"""The pose of a block of known size in one picture, or the reason why there is none.

A search in the reduced picture gives first guesses; each is refined on a hundred edge points that
are measured to a fraction of a pixel along the normals of the block's outline. What is fitted is
the box of `box.py`: place, yaw, and how far its edges are from the known ones. What the table or
the hand says about the height is part of the fit: one camera alone cannot tell a soft block that
is a percent smaller from one that is a percent further away.

Edge points that are hidden do not count; those that contradict the block speak against it; what
agrees in the end is the score.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from codesign_perception.box import (
    Outline,
    UndistortedImage,
    offsets_and_jacobian,
    outline,
    silhouette,
)
from codesign_perception.camera import Camera, Floats
from codesign_perception.config import EstimatorConfig
from codesign_perception.edges import Colors, EdgePoints, Image, strongest_edges, subpixel_edges
from codesign_perception.search import Guess, guesses

CORNER_MARGIN = 0.08  # share of an edge near its corners that is left out: corners are round
WIDE, MIDDLE, NARROW = 12.0, 6.0, 3.0  # px that edges are looked for in
CLEAR = 0.97  # score at which nothing stands around the block
GOOD = 0.85  # score at which no further guess is tried
FREE_SIGMA = 0.25  # m, of a height of which nothing is known
LIFT_GAIN = 0.1  # px^2: by how much a free height must fit better before the block counts as up
SIZE_LIMIT = 3.0  # standard deviations
FLOOR = np.array([5e-5, 5e-5, 5e-5, 1e-3])  # m, rad: errors that all points share, always added
SCALE = np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-3, 1e-3, 1e-3])  # mm and centiradians: well scaled


@dataclass(frozen=True)
class Held:
    """What the hand that holds the block says about its centre.

    Attributes:
        position: (3,) where it is expected in link_base [m].
        sigma: (3,) standard deviations of that [m]. A soft block gives way sideways while the
            fingers close on it; the picture decides, and where they hide it, this is what is left.
    """

    position: Floats
    sigma: tuple[float, float, float] = (0.002, 0.002, 0.001)


@dataclass(frozen=True)
class TofuPose:
    """Where the block is.

    Attributes:
        position: (3,) of the block's centre in link_base [m].
        yaw: of its long side from the x axis of link_base, in [-pi / 2, pi / 2) [rad]: a half turn
            cannot be seen.
        size: (3,) of the fitted box [m].
        covariance: (4, 4) of x, y, z [m^2] and yaw [rad^2], without the camera's own error.
        score: share of the outline that agrees with the picture, 0 to 1.
        rms: of the points that agree [px].
        state: "resting" on the table, "held" by the hand, or "lifted" by something unknown.
        outline: (N, 2) corners of the silhouette in the picture [px].
        colors: of block and surroundings.
    """

    position: Floats
    yaw: float
    size: Floats
    covariance: Floats
    score: float
    rms: float
    state: str
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
class _Belief:
    """What is known before the picture is: rows (K, 7), their values (K,) and sigmas (K,)."""

    name: str
    rows: Floats
    values: Floats
    sigmas: Floats


@dataclass(frozen=True)
class _Fit:
    belief: _Belief
    state: Floats
    covariance: Floats
    score: float
    denied: float
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
        self._size = np.array(self.config.settled_size)
        self._last: TofuPose | None = None
        self._table: Floats | None = None

    def reset(self) -> None:
        """Forget where the block was, and the table's colour."""
        self._last = self._table = None

    def estimate(self, image: Image, held: Held | None = None) -> Detection:
        """The block's pose in a picture.

        It is looked for where it was seen last, and everywhere if it is not there.

        Args:
            image: (height, width, 3) BGR, of the camera's size.
            held: where a hand that holds the block should have it. What the picture shows
                decides: a block that was dropped is found on the table.

        Raises:
            ValueError: a picture of another size or type.
        """
        shape = (self.camera.height, self.camera.width, 3)
        if image.shape != shape or image.dtype != np.uint8:
            raise ValueError(
                f"image is {image.shape} {image.dtype}: the camera's are {shape} uint8 (BGR)"
            )
        best = self._followed(image, held)
        if best is None or self._objection(best):
            best = self._searched(image, held, best)
        return self._judged(best)

    # -- attempts

    def _followed(self, image: Image, held: Held | None) -> _Fit | None:
        """From where it was last, or where the hand has it now."""
        if self._last is None:
            return None
        place = self._last.position if held is None else held.position
        start = np.array([*place, self._last.yaw, *self._last.size])
        return self._refined(image, Guess(start, 1.0, self._last.colors), held, wide=False)

    def _searched(self, image: Image, held: Held | None, best: _Fit | None) -> _Fit | None:
        """From the whole picture."""
        for guess in guesses(image, self._plane, self.config):
            if self._table is not None:  # seen when nothing stood around the block
                guess = replace(guess, colors=Colors(guess.colors.inside, self._table))
            fit = self._refined(image, guess, held, wide=True)
            if fit is not None and (best is None or self._rank(fit) > self._rank(best)):
                best = fit
            if best is not None and best.score > GOOD and not self._objection(best):
                break
        return best

    def _refined(self, image: Image, guess: Guess, held: Held | None, *, wide: bool) -> _Fit | None:
        """The best fit near a guess: held, at rest, or at whatever height fits."""
        if held is not None:
            fit = self._fit(image, guess, self._held(held), wide)
            if fit is not None and not self._objection(fit):
                return fit
        resting = self._fit(image, guess, self._resting(), wide)
        if resting is not None and resting.score > GOOD and not self._objection(resting):
            return resting
        lifted = self._fit(image, guess, self._lifted(guess.state[2]), wide)
        if lifted is None or lifted.state[2] < self.config.rest_height + 0.002:
            return resting
        if resting is None:
            return lifted
        return lifted if self._misfit(resting) - self._misfit(lifted) > LIFT_GAIN else resting

    # -- what is believed beforehand

    def _resting(self) -> _Belief:
        """The foot is on the table."""
        config = self.config
        row = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -0.5]])
        return self._belief(
            "resting", row, [config.table_height], [config.rest_sigma], config.size_sigma
        )

    def _held(self, held: Held) -> _Belief:
        """The centre is where the hand has it; the fingers squeeze."""
        return self._belief(
            "held", np.eye(7)[:3], held.position, held.sigma, self.config.held_size_sigma
        )

    def _lifted(self, z: float) -> _Belief:
        """Nothing is known but the size."""
        return self._belief("lifted", np.eye(7)[2:3], [z], [FREE_SIGMA], self.config.size_sigma)

    def _belief(
        self, name: str, rows: Floats, values: ArrayLike, sigmas: ArrayLike, size_sigma: float
    ) -> _Belief:
        """These (M, 7) rows about the place, and the size."""
        return _Belief(
            name,
            np.vstack([rows, np.eye(7)[4:]]),
            np.concatenate([values, self._size]),
            np.concatenate([sigmas, [size_sigma] * 3]),
        )

    # -- one fit

    def _fit(self, image: Image, guess: Guess, belief: _Belief, wide: bool) -> _Fit | None:
        """Gauss-Newton on edge points, measured again as the outline moves."""
        state, spacing = guess.state, self.config.spacing
        if belief.name == "resting":
            state = self._at_height(state, self.config.table_height + state[6] / 2.0)
        elif belief.name == "held":
            state = self._at_height(state, float(belief.values[2]))
        for _ in range(2 if wide else 1):
            line = outline(state, self._plane, 2.0 * spacing, CORNER_MARGIN)
            found = strongest_edges(image, self._plane, line, WIDE, guess.colors)
            solved = self._solved(state, line, found, belief)
            if solved is None:
                return None
            state = solved[0]
        for reach in (MIDDLE, NARROW, NARROW):
            line = outline(state, self._plane, spacing, CORNER_MARGIN)
            found = subpixel_edges(image, self._plane, line, reach, guess.colors)
            solved = self._solved(state, line, found, belief)
            if solved is None:
                return None
            state, covariance, residuals = solved
        agree = found.found & (np.abs(residuals) < self.config.max_residual)
        denied = found.denied | (found.found & ~agree)
        rms = float(np.sqrt(np.mean(residuals[agree] ** 2))) if agree.any() else np.inf
        on_edge = np.bincount(line.edges[agree], minlength=line.count)
        in_all = np.bincount(line.edges, minlength=line.count)
        edges = int((on_edge > 0.4 * np.maximum(in_all, 1)).sum())
        return _Fit(
            belief, state, covariance, float(agree.mean()), float(denied.mean()), rms, edges,
            guess.colors,
        )  # fmt: skip

    def _at_height(self, state: Floats, z: float) -> Floats:
        """The state with its centre at this height [m] that appears at the same place."""
        pixel, _ = self._plane.project(state[None, :3])
        place = self._plane.on_plane(pixel, z)[0]
        return state if np.isnan(place).any() else np.array([*place, *state[3:]])

    def _solved(
        self,
        state: Floats,
        line: Outline,
        points: EdgePoints,
        belief: _Belief,
    ) -> tuple[Floats, Floats, Floats] | None:
        """The state that edge points and belief speak for.

        Returns:
            state (7,), its covariance (7, 7), residuals (N,) [px]; None if the points fix none.
        """
        config, found, offsets = self.config, points.found, points.offsets
        if found.sum() < 12:
            return None
        rows = belief.rows * SCALE / belief.sigmas[:, None]
        prior = rows.T @ rows
        residuals, jacobian = offsets_and_jacobian(state, self._plane, line)
        residuals = offsets - residuals
        for _ in range(6):
            jacobian = jacobian * SCALE
            spread = 1.4826 * float(np.median(np.abs(residuals[found])))
            cut = max(4.7 * spread, config.max_residual)
            weight = np.where(found, np.maximum(1.0 - (residuals / cut) ** 2, 0.0) ** 2, 0.0)
            weight *= points.trust
            weight /= max(spread, config.noise_floor) ** 2 * config.correlation
            normal = jacobian.T @ (weight[:, None] * jacobian) + prior
            missing = (belief.values - belief.rows @ state) / belief.sigmas
            right = jacobian.T @ (weight * residuals) + rows.T @ missing
            try:
                step = np.linalg.solve(normal, right)
            except np.linalg.LinAlgError:
                return None
            length = float(np.abs(step).max())
            if not np.isfinite(length):
                return None
            state = state + SCALE * step * min(1.0, 20.0 / max(length, 1e-9))
            residuals, jacobian = offsets_and_jacobian(state, self._plane, line)
            residuals = offsets - residuals
            if length < 0.005:
                break
        if (state[4:] < 0.3 * self._size).any():
            return None
        try:
            covariance = SCALE[:, None] * np.linalg.inv(normal) * SCALE
        except np.linalg.LinAlgError:
            return None
        return state, covariance, residuals

    # -- judgement

    def _rank(self, fit: _Fit) -> float:
        return fit.score - fit.denied - 0.2 * min(fit.rms, 2.0)

    def _misfit(self, fit: _Fit) -> float:
        """Mean square distance of all points, missing ones at the limit [px^2]."""
        return fit.score * fit.rms**2 + (1.0 - fit.score) * self.config.max_residual**2

    def _objection(self, fit: _Fit) -> str:
        """Why a fit is not the block; empty if nothing speaks against it."""
        config = self.config
        x, y, z = fit.state[:3]
        x0, x1, y0, y1 = config.region
        held = fit.belief.name == "held"
        least = config.min_held_score if held else config.min_score
        if fit.score < least:
            return (
                f"only {fit.score:.0%} of the outline agrees with the picture, at least "
                f"{least:.0%} must: block hidden, of another size, or camera moved"
            )
        most = config.max_held_denied if held else config.max_denied
        if fit.denied > most:
            return (
                f"{fit.denied:.0%} of the outline contradicts the picture, at most {most:.0%} may: "
                "another thing, or another size"
            )
        if fit.edges < 3:
            return f"only {fit.edges} edges of the outline are visible, at least 3 must be"
        blunt = config.max_rms * (1.5 if held else 1.0)
        if fit.rms > blunt:
            return f"outline is off by {fit.rms:.2f} px rms, at most {blunt:.2f}"
        deviation = fit.state[4:] - self._size
        limit = SIZE_LIMIT * config.held_size_sigma if held else config.size_tolerance
        if np.abs(deviation).max() > limit:
            edge = int(np.abs(deviation).argmax())
            return (
                f"edge {edge} measures {1e3 * fit.state[4 + edge]:.1f} mm instead of "
                f"{1e3 * self._size[edge]:.1f}: another thing, or set size to it"
            )
        if not (x0 <= x <= x1 and y0 <= y <= y1):
            return f"block at x {x:.3f}, y {y:.3f} m: outside the region {config.region}"
        if not -0.005 <= z - config.rest_height <= config.max_lift:
            return f"block at height {z:.3f} m: not between the table and {config.max_lift} m above"
        if fit.belief.name == "lifted" and not config.allow_lifted:
            return (
                f"block seems to be {1e3 * (z - config.rest_height):.0f} mm above the table, but "
                "no hand holds it: camera moved, or another size; or set allow_lifted"
            )
        uncertain = float(np.sqrt(np.diag(fit.covariance)[:3].max()))
        if uncertain > config.max_sigma:
            return (
                f"place of the {fit.belief.name} block is uncertain by {1e3 * uncertain:.1f} mm, "
                f"at most {1e3 * config.max_sigma:.1f}: too little is visible"
            )
        return ""

    def _judged(self, fit: _Fit | None) -> Detection:
        if fit is None:
            return Detection(None, "nothing as bright and as large as the block in its region")
        objection = self._objection(fit)
        if objection:
            return Detection(None, objection, fit.score)
        _, pixels = silhouette(fit.state, self._plane)
        if fit.score > CLEAR:
            self._table = fit.colors.outside
        self._last = TofuPose(
            position=fit.state[:3].copy(),
            yaw=wrapped(float(fit.state[3])),
            size=fit.state[4:].copy(),
            covariance=fit.covariance[:4, :4] + np.diag(FLOOR**2),
            score=fit.score,
            rms=fit.rms,
            state=fit.belief.name,
            outline=self._plane.distorted(pixels),
            colors=fit.colors,
        )
        return Detection(self._last, "", fit.score)


def wrapped(yaw: float) -> float:
    """A yaw in [-pi / 2, pi / 2): a box looks the same after a half turn [rad]."""
    return (yaw + np.pi / 2.0) % np.pi - np.pi / 2.0
