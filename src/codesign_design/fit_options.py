"""Options of the search for a finger that is like a target."""

from dataclasses import dataclass


@dataclass(frozen=True)
class FitOptions:
    """How to search.

    Attributes:
        method: "icp" or "adam".
        restarts: starting points.
        iterations: at most, before polishing; all restarts in the first third, the better third
            of them after that.
        samples: per surface and iteration.
        polished: restarts that are polished at the end; the better third briefly before.
        polish_iterations: at most.
        patience: stop polishing after this many iterations without an improvement of 0.1 %.
        normal_weight: distance that a reversed normal counts for, halved [m].
        wall: smallest wall thickness to ask for [m]; 0 asks for none.
        closing: ask that nothing protrudes beyond y = 0, where the other finger is.
        seed: equal seeds give equal fits.
    """

    method: str = "icp"
    restarts: int = 64
    iterations: int = 36
    samples: int = 250
    polished: int = 4
    polish_iterations: int = 60
    patience: int = 12
    normal_weight: float = 0.004
    wall: float = 0.0
    closing: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises ValueError: a count below one, a negative length, or an unknown method."""
        if self.method not in ("icp", "adam"):
            raise ValueError(f"method {self.method!r}: choose icp or adam")
        for name in ("restarts", "iterations", "samples", "polished", "polish_iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("normal_weight", "wall"):
            if not 0.0 <= getattr(self, name) < 0.05:
                raise ValueError(f"{name} is {getattr(self, name)} m; it must be within [0, 0.05)")
