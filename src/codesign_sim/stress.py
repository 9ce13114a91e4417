"""Stress of the block, the figures the paper scores (section III-C and IV)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class StressMeasure(StrEnum):
    """Which stress tensor the von Mises value is taken of.

    COROTATED: 2 mu (S - I) + lambda tr(S - I) I with F = R S: force per rest area in the
        element's own frame, the stress of the co-rotated model itself. The paper's simulator is
        co-rotational and its figures are compared with ours, so this is the default.
    CAUCHY: force per deformed area, P F^T / det F, what a material test reports; 3-12 % lower
        than COROTATED in a squeezed block.
    """

    CAUCHY = "cauchy"
    COROTATED = "corotated"


@dataclass(frozen=True, eq=False)
class Stress:
    """Von Mises stress in Pa, per environment.

    Attributes:
        von_mises: (E, T) per tetrahedron.
        top10_mean: (E,) mean of the tenth of the tetrahedra with the highest values.
        mean: (E,) volume-weighted mean.
        median: (E,) median over the tetrahedra.
        measure: which stress tensor.
    """

    von_mises: np.ndarray
    top10_mean: np.ndarray
    mean: np.ndarray
    median: np.ndarray
    measure: StressMeasure


def summarise(von_mises: np.ndarray, volumes: np.ndarray, measure: StressMeasure) -> Stress:
    """Statistics of per-tetrahedron values (E, T) with rest volumes (T,)."""
    count = von_mises.shape[1]
    top = max(1, round(count / 10))
    middle = (count - 1) // 2, count // 2
    ordered = np.partition(von_mises, sorted({*middle, count - top}), axis=1)
    return Stress(
        von_mises=von_mises,
        top10_mean=ordered[:, count - top :].mean(axis=1),
        mean=von_mises @ (volumes / volumes.sum()),
        median=ordered[:, middle].mean(axis=1),
        measure=measure,
    )
