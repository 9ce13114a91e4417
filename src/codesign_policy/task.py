"""Observation and action of the task: the one definition for training and for the policy node.

Paper, section II: o = [p_ee, p_obj, w_ee, f, d] and a_C = [dp_ee, dq_ee, dw_ee].
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

TASK_VERSION = 3  # of observation, action and reward components: stored transitions name it
POLICY_PERIOD = 0.05  # s, 20 Hz
EPISODE_STEPS = 200  # 10 s

# Largest change in one policy period: 0.08 m/s along x and y, 0.14 m/s along z, 0.2 rad/s about
# each axis, 0.05 m/s of the gap. Within what the controller accepts in one action (0.25 m/s,
# 1 rad/s). Larger ones make exploration too rough for tofu, and rotation, which is not observed,
# adds up.
MAX_TRANSLATION = np.array([0.004, 0.004, 0.007])  # m
MAX_ROTATION = 0.010  # rad, each axis
MAX_WIDTH_CHANGE = 0.0025  # m
ACTION_SCALE = np.array([*MAX_TRANSLATION, *[MAX_ROTATION] * 3, MAX_WIDTH_CHANGE])

ACTION_NAMES = ("dx", "dy", "dz", "rx", "ry", "rz", "dw")
ACTION_ROUNDING = 1e-6  # beyond [-1, 1], for networks in single precision

DESIGN_STAGE, CONTROL_STAGE = 0.0, 1.0  # f

# Where the grasp frame may be told to go, in link_base: in front of the arm, above its foot.
WORKSPACE_LOWER = np.array([0.20, -0.40, 0.0])  # m
WORKSPACE_UPPER = np.array([0.75, 0.40, 0.60])  # m

# A network sees (o - ORIGIN) / SCALE: decimetres from a point above the table's middle, and the
# gap in units of the tofu's thickness; f and the design d are of order one as they are.
_CENTRE = [0.45, 0.0, 0.1]  # m
OBSERVATION_ORIGIN = np.array([*_CENTRE, *_CENTRE, 0.03, 0.0])
OBSERVATION_SCALE = np.array([0.1] * 6 + [0.03, 1.0])

# A millimetre decides over a grasp and is a hundredth of these units: too little for a network to
# see. The encoding adds tanh((u - centre) / width) of what matters, u [m]: the tool relative to the
# object along x, y, z, the heights of tool and object, and the gap. Far away it says nothing new.
_ENCODING = (  # u as a sum of numbers of the observation {index: factor}, centre, width [m]
    *(({k: 1.0, 3 + k: -1.0}, 0.0, width) for width in (0.01, 0.03) for k in range(3)),
    ({2: 1.0}, 0.0, 0.03),
    ({5: 1.0}, 0.02, 0.02),
    *(({6: 1.0}, centre, 0.008) for centre in (0.015, 0.030, 0.045)),
)
ENCODED = len(_ENCODING)  # numbers that it adds


def _encoding() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Factors (8, ENCODED) and offsets (ENCODED,) of the encoding for normalised observations."""
    factors, offsets = np.zeros((8, ENCODED)), np.zeros(ENCODED)
    for k, (terms, centre, width) in enumerate(_ENCODING):
        for index, factor in terms.items():
            factors[index, k] = factor * OBSERVATION_SCALE[index] / width
            offsets[k] += factor * OBSERVATION_ORIGIN[index] / width
        offsets[k] -= centre / width
    return factors.astype(np.float32), offsets.astype(np.float32)


_FACTORS, _OFFSETS = _encoding()


def scaled_actions(actions: NDArray[np.floating], count: int) -> NDArray[np.float64]:
    """[dp, dq, dw] in SI units, (count, 7), of as many actions in [-1, 1].

    Raises:
        ValueError: another shape, or an action that is not finite or out of range; names its lane.
    """
    given = np.asarray(actions, dtype=np.float64)
    if given.shape != (count, 7):
        raise ValueError(f"actions have shape {given.shape}: give one of 7 numbers for {count}")
    bad = ~(np.abs(given) <= 1.0 + ACTION_ROUNDING)  # so that NaN counts as bad
    if bad.any():
        lane, which = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"action of lane {lane}: {ACTION_NAMES[which]} is {given[lane, which]}; "
            "it must be within [-1, 1], the limits of one step: clip it"
        )
    return np.clip(given, -1.0, 1.0) * ACTION_SCALE


def normalised_observations(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a network sees of [p_ee, p_obj, w_ee, f, d], (..., 8 + D), in SI units."""
    scaled = np.array(vectors, dtype=np.float64)
    scaled[..., :8] = (scaled[..., :8] - OBSERVATION_ORIGIN) / OBSERVATION_SCALE
    return scaled


def physical_observations(vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    """The inverse of `normalised_observations`."""
    physical = np.array(vectors, dtype=np.float64)
    physical[..., :8] = physical[..., :8] * OBSERVATION_SCALE + OBSERVATION_ORIGIN
    return physical


def encoded(observations: NDArray[np.floating]) -> NDArray[np.float32]:
    """Normalised observations (..., 8 + D) with the encoding after their 8th number.

    Returns:
        (..., 8 + ENCODED + D).
    """
    given = np.asarray(observations, np.float32)
    added = np.tanh(given[..., :8] @ _FACTORS + _OFFSETS)
    return np.concatenate([given[..., :8], added, given[..., 8:]], axis=-1)


def design_stage_observation(parameters: int) -> NDArray[np.float32]:
    """o_D as a network sees it, (8 + parameters,): f = 0 and, as nothing has happened, zeros."""
    observation = np.zeros(8 + parameters, dtype=np.float32)
    observation[7] = DESIGN_STAGE
    return observation


@dataclass(frozen=True)
class Observation:
    """What a policy sees in the control stage. Positions in link_base.

    Attributes:
        tcp_position: p_ee, (3,) [m].
        object_position: p_obj, centre of the object, (3,) [m].
        width: w_ee, gap between the fingers' most protruding points [m].
        design: d, the parameters of the fingers in use; empty for fingers made without a cage.
    """

    tcp_position: NDArray[np.float64]
    object_position: NDArray[np.float64]
    width: float
    design: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    def vector(self) -> NDArray[np.float64]:
        """[p_ee, p_obj, w_ee, f, d] with f = 1, the flag of the control stage; (8 + D,)."""
        return np.concatenate(
            [
                self.tcp_position,
                self.object_position,
                [self.width, CONTROL_STAGE],
                self.design,
            ]
        )

    def normalised(self) -> NDArray[np.float64]:
        """`vector()` as a network sees it, (8 + D,), dimensionless and of order one."""
        return normalised_observations(self.vector())

    @classmethod
    def from_normalised(cls, vector: NDArray[np.floating]) -> "Observation":
        """The inverse of `normalised`."""
        physical = physical_observations(vector)
        return cls(physical[:3], physical[3:6], float(physical[6]), physical[8:])

    def is_finite(self) -> bool:
        """Whether every number of it is finite."""
        return bool(np.isfinite(self.vector()).all())


@dataclass(frozen=True)
class ControlAction:
    """a_C: what to add to the commanded pose and gap over one policy period.

    Attributes:
        translation: dp_ee, (3,) [m], in link_base.
        rotation: dq_ee, rotation vector, (3,) [rad], in link_base.
        width: dw_ee [m].
    """

    translation: NDArray[np.float64]
    rotation: NDArray[np.float64]
    width: float

    @classmethod
    def from_normalised(cls, action: NDArray[np.float64]) -> "ControlAction":
        """From a network's output in [-1, 1]^7; values outside are clipped.

        Raises:
            ValueError: not 7 numbers, or one of them is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (7,) or not np.isfinite(action).all():
            raise ValueError(f"action {action}: must be 7 finite numbers")
        scaled = np.clip(action, -1.0, 1.0) * ACTION_SCALE
        return cls(scaled[:3], scaled[3:6], float(scaled[6]))

    def normalised(self) -> NDArray[np.float64]:
        """[dp, dq, dw] over its limits, (7,); within [-1, 1] for an allowed action."""
        return np.concatenate([self.translation, self.rotation, [self.width]]) / ACTION_SCALE

    def clipped(self) -> "ControlAction":
        """The nearest allowed action, component by component."""
        return ControlAction.from_normalised(self.normalised())
