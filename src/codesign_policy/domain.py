"""What is drawn at the start of a trial (paper, section IV-A)."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

# Paper, section IV-A: Young's modulus and Poisson ratio of silk tofu.
YOUNG_MODULUS_RANGE = (8e3, 10e3)  # Pa
POISSON_RATIO_RANGE = (0.300, 0.325)
BLOCK_SIZE = (0.050, 0.030, 0.040)  # m along x, y (the fingers' opening) and z
# The paper fixes neither; these are ours.
DENSITY = 1020.0  # kg/m^3
FRICTION = 0.5
POSITION = (0.45, 0.0)  # m, in link_base
POSITION_SPREAD = 0.004  # m, uniform, each axis


@dataclass(frozen=True)
class TrialDomain:
    """Material and placement of one trial; NaN in a request means: draw it.

    Attributes:
        young_modulus: [Pa].
        poisson_ratio: [-].
        density: [kg/m^3].
        friction: Coulomb coefficient of fingers and table [-].
        x, y: centre of the block's base in link_base [m].
        yaw: about link_base z [rad].
    """

    young_modulus: float = math.nan
    poisson_ratio: float = math.nan
    density: float = math.nan
    friction: float = math.nan
    x: float = math.nan
    y: float = math.nan
    yaw: float = math.nan


def draw_domain(
    seed: int,
    request: TrialDomain | None = None,
    friction: tuple[float, float] = (FRICTION, FRICTION),
) -> TrialDomain:
    """Fills the NaNs of a request from a seed.

    Neither what is requested nor the range of friction changes what the seed draws for the rest.

    Args:
        seed: not negative.
        request: values to keep; None draws everything.
        friction: range that it is drawn from.

    Raises:
        ValueError: negative seed, or a requested value outside its physical range.
    """
    if seed < 0:
        raise ValueError(f"seed {seed}: must not be negative")
    random = np.random.default_rng(seed)
    drawn = TrialDomain(
        young_modulus=random.uniform(*YOUNG_MODULUS_RANGE),
        poisson_ratio=random.uniform(*POISSON_RATIO_RANGE),
        density=DENSITY,
        x=POSITION[0] + random.uniform(-POSITION_SPREAD, POSITION_SPREAD),
        y=POSITION[1] + random.uniform(-POSITION_SPREAD, POSITION_SPREAD),
        friction=random.uniform(*friction),
        yaw=0.0,
    )
    return _filled(request or TrialDomain(), drawn)


def domain_corners(
    request: TrialDomain | None = None, friction: tuple[float, float] = (FRICTION, FRICTION)
) -> tuple[TrialDomain, TrialDomain]:
    """The lowest and the highest value of everything that `draw_domain` can draw.

    Raises:
        ValueError: a requested value or a friction outside its physical range.
    """
    request = request or TrialDomain()

    def corner(k: int) -> TrialDomain:
        spread = (-POSITION_SPREAD, POSITION_SPREAD)[k]
        return _filled(
            request,
            TrialDomain(
                young_modulus=YOUNG_MODULUS_RANGE[k],
                poisson_ratio=POISSON_RATIO_RANGE[k],
                density=DENSITY,
                friction=friction[k],
                x=POSITION[0] + spread,
                y=POSITION[1] + spread,
                yaw=0.0,
            ),
        )

    if friction[0] > friction[1]:
        raise ValueError(f"friction range {friction}: give the lower number first")
    return corner(0), corner(1)


def _filled(request: TrialDomain, drawn: TrialDomain) -> TrialDomain:
    """The request, with what is NaN taken from what was drawn."""
    given = {
        f.name: getattr(request, f.name)
        for f in fields(request)
        if not math.isnan(getattr(request, f.name))
    }
    return _checked(replace(drawn, **given))


def _checked(domain: TrialDomain) -> TrialDomain:
    limits = {
        "young_modulus": (0.0, math.inf, "Pa"),
        "poisson_ratio": (-1.0, 0.5, ""),
        "density": (0.0, math.inf, "kg/m^3"),
        "friction": (-1e-12, math.inf, ""),
        "x": (-math.inf, math.inf, "m"),
        "y": (-math.inf, math.inf, "m"),
        "yaw": (-math.inf, math.inf, "rad"),
    }
    for name, (low, high, unit) in limits.items():
        value = getattr(domain, name)
        if not low < value < high:
            raise ValueError(f"{name} {value} {unit}: must be above {low} and below {high}")
    return domain
