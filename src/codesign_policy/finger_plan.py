"""The scripted grasp's settings for a pair of fingers, from their shape alone.

Seen along the closing direction each finger is a depth map in front of the block. Pads squeeze:
the block is taken for an elastic foundation of linear springs (Winkler), and the gap is where they
press with a margin over the least force that friction needs, m g / 2 mu. Fingers with a lip at
the foot carry the weight: they slide in at table height until their pads just touch.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_design.finger_pair import FingerPair, TriangleMesh
from codesign_policy.domain import BLOCK_SIZE, DENSITY, FRICTION, YOUNG_MODULUS_RANGE
from codesign_policy.scripted import GraspPlan

GRIP_MARGIN = 1.4  # normal force over the least that holds
LEAST_LIP = 0.003  # m, a foot that protrudes less is part of the pad
LEAST_SIDE_ROOM = 0.004  # m between block and finger, each side, while they come down
PAD_BAND = (0.010, 0.030)  # m above the tips, where the pad is looked for
PAD_TOUCH = 0.0001  # m of squeeze between the pads of fingers with lips
SCOOP_CLEARANCE = 0.0001  # m above the table
SCOOP_SPEED = 0.020  # m/s, peak closing speed of the gap
WIDTH_STEP = 0.0001  # m, to which the gap is rounded, downwards
_CELL = 0.0025  # m, of the depth map
_GRAVITY = 9.81


@dataclass(frozen=True)
class FrontView:
    """One finger seen from the block.

    Attributes:
        depth: (Z, X) how far behind the most protruding point of the finger each spot of the
            block's side is met [m]; inf where there is no finger.
        height: (Z,) of the rows above the finger tips [m].
        foot: depth of the foremost point below the pad [m].
    """

    depth: NDArray[np.float64]
    height: NDArray[np.float64]
    foot: float

    @property
    def pad(self) -> float:
        """Depth of the pad: of the foremost spot between the heights of `PAD_BAND` [m]."""
        low, high = PAD_BAND
        return float(self.depth[(self.height > low) & (self.height < high)].min())

    @property
    def lip(self) -> float:
        """How far the foot protrudes beyond the pad [m], 0 if it does not."""
        return max(0.0, self.pad - self.foot)


def front_view(mesh: TriangleMesh) -> FrontView:
    """The left finger in front of a block that stands at its tips."""
    x = _centres(-BLOCK_SIZE[0] / 2.0, BLOCK_SIZE[0] / 2.0)
    height = _centres(0.0, BLOCK_SIZE[2])
    z = mesh.vertices[:, 2].max() - height
    rays = np.stack(np.meshgrid(x, z, indexing="xy"), axis=-1).reshape(-1, 2)
    corners = mesh.vertices[mesh.faces]
    normal_y = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 1]
    corners = corners[normal_y < 0.0]  # the others face away from the block
    depth = np.concatenate([_first_hit(part, corners) for part in np.array_split(rays, 16)])
    front, tip = mesh.vertices[:, 1].min(), mesh.vertices[:, 2].max()
    foot = mesh.vertices[mesh.vertices[:, 2] > tip - PAD_BAND[0], 1].min()
    return FrontView(depth.reshape(len(z), len(x)) - front, height, float(foot - front))


def plan_for(fingers: FingerPair) -> GraspPlan:
    """The scripted grasp that suits these fingers.

    Raises:
        ValueError: nothing of the fingers is in front of the block, or they do not open or close
            far enough.
    """
    view = front_view(fingers.left)
    if not np.isfinite(view.pad):
        raise ValueError(
            f"fingers {fingers.name!r}: no pad between {PAD_BAND[0]} and {PAD_BAND[1]} m above "
            "the tips; let the finger reach that high"
        )
    least_open = BLOCK_SIZE[1] + 2.0 * LEAST_SIDE_ROOM
    if fingers.max_width < least_open:
        raise ValueError(
            f"fingers {fingers.name!r} open to {fingers.max_width} m, the block needs "
            f"{least_open} m: make them less deep"
        )
    if view.lip > LEAST_LIP:
        plan = GraspPlan(
            width=round(BLOCK_SIZE[1] - PAD_TOUCH - 2.0 * view.pad, 6),
            open_width=least_open,
            clearance=SCOOP_CLEARANCE,
            close_speed=SCOOP_SPEED,
        )
    else:
        plan = GraspPlan(width=_squeezing_width(view), open_width=min(0.046, fingers.max_width))
    if plan.width < fingers.min_width:
        raise ValueError(
            f"fingers {fingers.name!r} close to {fingers.min_width} m, the grasp needs "
            f"{plan.width} m: make their lips shorter"
        )
    return plan


def _squeezing_width(view: FrontView) -> float:
    """Gap at which the elastic foundation presses with the force that is wanted [m]."""
    weight = DENSITY * float(np.prod(BLOCK_SIZE)) * _GRAVITY
    wanted = GRIP_MARGIN * weight / (2.0 * FRICTION)
    thickness = BLOCK_SIZE[1]
    stiffness = np.mean(YOUNG_MODULUS_RANGE) / thickness * _CELL**2  # N/m per cell

    def force(width: float) -> float:
        squeeze = np.maximum(0.0, thickness - width - 2.0 * view.depth)
        return float(stiffness * squeeze.sum())

    low, high = 0.0, thickness
    if force(low) < wanted:
        raise ValueError("the fingers meet before they press hard enough; make their pads wider")
    while high - low > 1e-6:
        middle = (low + high) / 2.0
        low, high = (middle, high) if force(middle) > wanted else (low, middle)
    return round(np.floor(low / WIDTH_STEP + 1e-3) * WIDTH_STEP, 6)


def _centres(low: float, high: float) -> NDArray[np.float64]:
    """Cell centres of a division into cells of about `_CELL` [m]."""
    count = round((high - low) / _CELL)
    return low + (np.arange(count) + 0.5) * (high - low) / count


def _first_hit(rays: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smallest y (R,) of triangles (F, 3, 3) over points (R, 2) of the x, z plane; inf: none."""
    a, b, c = (corners[:, k][:, [0, 2]] for k in range(3))
    ab, ac, ap = b - a, c - a, rays[:, None] - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    v = (ap[..., 0] * ac[:, 1] - ap[..., 1] * ac[:, 0]) / area
    w = (ab[:, 0] * ap[..., 1] - ab[:, 1] * ap[..., 0]) / area
    inside = (v >= -1e-9) & (w >= -1e-9) & (v + w <= 1.0 + 1e-9)
    y = corners[:, 0, 1]
    hit = y + v * (corners[:, 1, 1] - y) + w * (corners[:, 2, 1] - y)
    return np.where(inside, hit, np.inf).min(axis=1, initial=np.inf)
