"""Settings of the pose estimator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class EstimatorConfig:
    """What the block is like and what is believed.

    Attributes:
        size: edges of the block as it is cut, the first along yaw, the last upright [m].
        sag: how far the top of the block sinks under its own weight, rho g h^2 / (2 E) of the soft
            material; 0 for a rigid one [m].
        poisson_ratio: how much the block widens while it sinks.
        table_height: z of the table in link_base [m].
        region: x min, x max, y min, y max where the block's centre may be [m].
        allow_lifted: whether to tell the pose of a block off the table that no hand holds. It is
            less certain, and a camera that was moved sees such blocks.
        max_lift: largest height of the block's underside above the table [m].
        reduction: every how many-th pixel the search looks at.
        min_contrast: brightness that the block must have above the table [grey levels].
        min_overlap: of a bright patch with the block's silhouette, intersection over union.
        spacing: of the measured points along the outline [px].
        max_residual: distance from the fitted outline at which a point no longer agrees [px].
        min_score: share of the outline that must agree with the picture.
        min_held_score: the same while a hand holds the block, whose fingers hide much of it.
        max_rms: of the points that agree, from the fitted outline [px]; a half more while held.
        max_denied: share of the outline that may contradict the picture; what is merely hidden
            contradicts nothing.
        max_held_denied: the same while fingers squeeze the block out of shape.
        rest_sigma: uncertainty of the table's height [m].
        size_sigma: of the edges of a block that is left alone: how exactly it was cut [m].
        size_tolerance: how far the edges of a block left alone may be from `size` [m].
        held_size_sigma: of the edges of a block between the fingers [m].
        max_sigma: largest standard deviation of x or y that is still told [m].
        noise_floor: least uncertainty of an edge point that is assumed [px].
        correlation: how many neighbouring edge points err together.
    """

    size: tuple[float, float, float] = (0.05, 0.03, 0.04)
    sag: float = 0.0009
    poisson_ratio: float = 0.31
    table_height: float = 0.0
    region: tuple[float, float, float, float] = (0.20, 0.75, -0.40, 0.40)
    allow_lifted: bool = False
    max_lift: float = 0.25
    reduction: int = 4
    min_contrast: float = 25.0
    min_overlap: float = 0.6
    spacing: float = 4.0
    max_residual: float = 1.5
    min_score: float = 0.5
    min_held_score: float = 0.35
    max_denied: float = 0.15
    max_held_denied: float = 0.35
    max_rms: float = 0.8
    rest_sigma: float = 0.0001
    size_sigma: float = 0.0003
    size_tolerance: float = 0.002
    held_size_sigma: float = 0.0025
    max_sigma: float = 0.003
    noise_floor: float = 0.08
    correlation: float = 4.0

    def __post_init__(self) -> None:
        """Checks what would make nonsense of every result.

        Raises:
            ValueError: names the value.
        """
        if len(self.size) != 3 or not all(0.005 <= s <= 0.5 for s in self.size):
            raise ValueError(f"size {self.size} m: three edges, 0.005 to 0.5 m each")
        if not 0.0 <= self.sag < 0.2 * self.size[2]:
            raise ValueError(f"sag {self.sag} m: 0 to a fifth of the height, {self.size[2]} m")
        x0, x1, y0, y1 = self.region
        if not (x0 < x1 and y0 < y1):
            raise ValueError(f"region {self.region} m: must be x min < x max, y min < y max")
        for name in ("min_score", "min_held_score"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} {getattr(self, name)}: must be in (0, 1]")
        if self.reduction not in (1, 2, 4, 8):
            raise ValueError(f"reduction {self.reduction}: 1, 2, 4 or 8")
        for name in (
            "max_lift",
            "spacing",
            "max_residual",
            "rest_sigma",
            "noise_floor",
            "size_sigma",
        ):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} {getattr(self, name)}: must be above 0")

    @property
    def settled_size(self) -> tuple[float, float, float]:
        """Edges of the box that the block fills at rest: lower, and wider by Poisson's ratio."""
        length, width, height = self.size
        # Mean strain over the height is half of that at the foot, and equal to sag / height.
        wider = 1.0 + self.poisson_ratio * self.sag / height
        return length * wider, width * wider, height - self.sag

    @property
    def rest_height(self) -> float:
        """z of the settled box's centre [m]."""
        return self.table_height + self.settled_size[2] / 2.0
