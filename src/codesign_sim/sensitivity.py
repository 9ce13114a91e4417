"""How the stress in the held block depends on the shape of the fingers.

Central finite differences over environments: one simulation holds every perturbed finger pair, so
that a gradient costs about as much as one grasp per two lanes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from codesign_sim.block import Block
from codesign_sim.checks import require_finite, require_per_environment, require_positive
from codesign_sim.fingers import FingerTargets
from codesign_sim.material import Material
from codesign_sim.mesh import SurfaceMesh
from codesign_sim.simulator import Simulator

Fingers = tuple[SurfaceMesh, SurfaceMesh]
MakeFingers = Callable[[np.ndarray], Fingers]
Progress = Callable[[int, int], None]

_OPEN_MARGIN = 0.004  # m, opening beyond the block's thickness before closing
_CLOSING_TIME, _WAIT, _HOLD = 0.5, 0.1, 0.2  # s
_LIFT_SPEED = 0.1  # m/s
_RISE_HELD = 0.7  # share of the lift that a held block follows


@dataclass(frozen=True)
class Grasp:
    """A grasp from above: close, wait, lift, hold, come to rest.

    Attributes:
        width: gap the fingers close to, metres.
        height: of the grasp frame above the table, metres.
        lift: metres.
        material: of the block, and its friction.
        block: shape and mesh.
    """

    width: float = 0.026
    height: float = 0.026
    lift: float = 0.02
    material: Material = Material()  # noqa: RUF009  (immutable)
    block: Block = field(default_factory=lambda: Block.tofu(2400))


@dataclass(frozen=True, eq=False)
class HeldStress:
    """Co-rotated von Mises stress in the held block at rest, per finger pair (L,), Pa.

    Attributes:
        top10: mean of the highest tenth.
        median: over the tetrahedra.
        held: whether the block rose with the fingers; figures of a dropped block say nothing.
    """

    top10: np.ndarray
    median: np.ndarray
    held: np.ndarray


@dataclass(frozen=True, eq=False)
class StressGradient:
    """Stress at the given parameters and its derivatives by them (P,).

    Attributes:
        parameters, steps: as given.
        top10, median: Pa.
        top10_gradient, median_gradient: Pa per unit of each parameter; nan where a perturbed pair
            dropped the block.
        held: (P, 2) whether the pairs at minus and plus a step held it.
        lanes: environments simulated, 2 P + 1.
        cpu_seconds: of this process, meshes and distance grids included.
    """

    parameters: np.ndarray
    steps: np.ndarray
    top10: float
    median: float
    top10_gradient: np.ndarray
    median_gradient: np.ndarray
    held: np.ndarray
    lanes: int
    cpu_seconds: float

    def as_dict(self) -> dict[str, object]:
        """For JSON; null where there is no derivative."""
        values = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }
        for name in ("top10_gradient", "median_gradient"):
            values[name] = [None if np.isnan(v) else v for v in getattr(self, name).tolist()]
        return values


def stress_gradient(
    make_fingers: MakeFingers,
    parameters: Sequence[float] | np.ndarray,
    steps: Sequence[float] | np.ndarray,
    grasp: Grasp = Grasp(),
    progress: Progress | None = None,
) -> StressGradient:
    """d(top-10 % stress) and d(median) by d(design parameters), central differences.

    A step must reach over the unevenness that the columns of contact points leave, a third of a
    cell on either edge: 2 mm in a pad's width at 2,400 tetrahedra (see docs/simulator.md for what
    error remains). Where the whole face moves, 0.25 mm will do.

    Args:
        make_fingers: from parameters (P,) to the (left, right) surfaces in the grasp frame.
        parameters: (P,) where to differentiate.
        steps: (P,) perturbations, above 0, in the parameters' units.
        grasp: motion, material and block, the same for all.
        progress: called with (motions done, motions in all).
    Raises:
        ValueError: wrong arguments; the unperturbed fingers drop the block.
    """
    start = time.process_time()
    parameters = require_finite("parameters", parameters, (-1,))
    steps = require_positive("finite-difference steps", steps, parameters.shape)
    moves = np.diag(steps)
    designs = [parameters, *(parameters - moves), *(parameters + moves)]
    stress = held_stress([make_fingers(p) for p in designs], grasp, progress=progress)
    if not stress.held[0]:
        raise ValueError(
            f"the fingers drop the block at a width of {grasp.width * 1e3:g} mm, so its held "
            "stress has no derivative: close further"
        )
    held = stress.held[1:].reshape(2, -1).T

    def gradient(values: np.ndarray) -> np.ndarray:
        minus, plus = values[1:].reshape(2, -1)
        return np.where(held.all(axis=1), (plus - minus) / (2 * steps), np.nan)

    return StressGradient(
        parameters=parameters,
        steps=steps,
        top10=float(stress.top10[0]),
        median=float(stress.median[0]),
        top10_gradient=gradient(stress.top10),
        median_gradient=gradient(stress.median),
        held=held,
        lanes=len(designs),
        cpu_seconds=time.process_time() - start,
    )


def held_stress(
    pairs: Sequence[Fingers],
    grasp: Grasp = Grasp(),
    widths: np.ndarray | None = None,
    progress: Progress | None = None,
) -> HeldStress:
    """Stress of the block held by each finger pair, all pairs side by side.

    Args:
        pairs: (left, right) surfaces, one pair per environment.
        grasp: motion, material and block.
        widths: (L,) closing widths in metres instead of the grasp's.
        progress: called with (motions done, motions in all).
    """
    lanes = len(pairs)
    width = grasp.width if widths is None else widths
    width = require_per_environment("closing width", width, lanes, (), "m")
    opening = np.full(lanes, grasp.block.size[1] + _OPEN_MARGIN)

    def at(width: np.ndarray, rise: float) -> FingerTargets:
        place = np.tile([0.0, 0.0, grasp.height + rise], (lanes, 1))
        return FingerTargets.from_above(place, width)

    simulator = Simulator(grasp.block, list(pairs), lanes)
    simulator.reset(grasp.material, fingers=at(opening, 0.0))
    motions = [
        (_CLOSING_TIME, at(width, 0.0)),
        (_WAIT, None),
        (grasp.lift / _LIFT_SPEED, at(width, grasp.lift)),
        (_HOLD, None),
    ]
    for done, (duration, targets) in enumerate(motions):
        if progress is not None:
            progress(done, len(motions) + 1)
        simulator.advance(duration, targets)
    rise = simulator.object_pose()[0][:, 2] - grasp.block.size[2] / 2
    simulator.settle()
    if progress is not None:
        progress(len(motions) + 1, len(motions) + 1)
    stress = simulator.stress()
    return HeldStress(stress.top10_mean, stress.median, rise > _RISE_HELD * grasp.lift)


def roughness(x: np.ndarray, y: np.ndarray, degree: int = 4) -> float:
    """How far a curve is from smooth: rms deviation of y from a polynomial fit, in y's unit.

    A quartic follows what the stress does over a sweep of one dimension; what is left is the noise
    of contact points and distance grids, which finite differences would amplify.
    """
    centred = (x - np.mean(x)) / np.ptp(x)
    return float(np.sqrt(np.mean((y - np.polyval(np.polyfit(centred, y, degree), centred)) ** 2)))
