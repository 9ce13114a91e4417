"""One compared figure."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np


@dataclass(frozen=True)
class Check:
    """A measured figure beside the expected one.

    Attributes:
        name: case and quantity.
        expected, measured, tolerance: in `unit`; the tolerance is absolute.
        unit: SI unit, "" for a plain number.
        at_least: the expected figure is a lower bound instead of a value to meet.
    """

    name: str
    expected: float
    measured: float
    tolerance: float
    unit: str
    at_least: bool = False

    @property
    def passed(self) -> bool:
        """Whether the measured figure is within the tolerance."""
        error = self.measured - self.expected
        wrong = -error if self.at_least else abs(error)
        return bool(np.isfinite(self.measured) and wrong <= self.tolerance)

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        fields = {
            k: (float(v) if isinstance(v, np.floating) else v) for k, v in asdict(self).items()
        }
        return {**fields, "passed": self.passed}
