"""A trained pair as a policy: its control, with the fingers that it was trained for."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from codesign_design.stock import stock_fingers
from codesign_policy.policy_file import TrainedPair
from codesign_policy.task import EPISODE_STEPS, ControlAction, Observation

DESIGN_ROUNDING = 1e-6  # the pair's design is in single precision


class Fingers(Protocol):
    """What tells fingers apart: a `FingerPair`, or the message FingerDesign."""

    @property
    def name(self) -> str:
        """For people."""

    @property
    def cage(self) -> str:
        """Design space that shaped them; empty for none."""

    @property
    def parameters(self) -> Sequence[float]:
        """Of the design."""

    @property
    def content_hash(self) -> str:
        """SHA-256 of geometry and limits."""


def mismatch(pair: TrainedPair, fingers: Fingers) -> str:
    """What is wrong with the fingers in use for this pair; empty if they are its own."""
    used = f"fingers {fingers.name!r} are in use"
    if not pair.space:
        same = fingers.content_hash == stock_fingers().content_hash
        return "" if same else f"{used}, the policy was trained with the stock fingers"
    if fingers.cage != pair.space:
        made = f"of {fingers.cage!r}" if fingers.cage else "made without a cage"
        return f"{used}, {made}, the policy was trained with a design of {pair.space!r}"
    given, own = np.asarray(fingers.parameters, np.float64), pair.design
    if given.shape != own.shape:
        return f"{used} with {len(given)} parameters, the policy was trained with {len(own)}"
    apart = np.abs(given - own)
    if not (apart <= DESIGN_ROUNDING).all():  # so that NaN counts as apart
        k = int(apart.argmax())
        theirs = f"parameter {k} is {given[k]:.6g}"
        return f"{used} whose {theirs}, the policy was trained with {own[k]:.6g}"
    return ""


class LearnedGrasp:
    """Answers with the actor's mean action for the steps of one episode, then holds still."""

    def __init__(self, pair: TrainedPair, fingers: Fingers) -> None:
        """Args: the pair; the fingers in use.

        Raises:
            ValueError: other fingers than the pair's, or an actor for other observations.
        """
        wrong = mismatch(pair, fingers)
        if wrong:
            raise ValueError(f"{wrong}: order the policy's own, as its ~/prepare does")
        size = 8 + len(pair.design)
        if (pair.observation_size, pair.control_size) != (size, 7):
            raise ValueError(
                f"the policy takes {pair.observation_size} numbers and answers "
                f"{pair.control_size}; observations of its fingers have {size}, actions 7"
            )
        self._pair = pair
        self.reset()

    def reset(self) -> None:
        """Forgets the last trial."""
        self._steps = 0

    @property
    def phase(self) -> str:
        """The one stage there is, while it lasts."""
        return "done" if self.done else "control" if self._steps else "idle"

    @property
    def done(self) -> bool:
        """True once it was asked again after the episode's last step: that step has been made."""
        return self._steps > EPISODE_STEPS

    def act(self, observation: Observation) -> ControlAction:
        """The mean action."""
        self._steps += 1
        if self.done:
            return ControlAction(np.zeros(3), np.zeros(3), 0.0)
        action = self._pair.act(observation.normalised())
        return ControlAction.from_normalised(action.astype(np.float64))
