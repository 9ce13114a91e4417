"""Teleoperation: what a person does with a joystick or a keyboard, as actions of the task.

Nothing is sent unless somebody means it: a joystick needs its dead-man button held and a message
that is not older than the timeout; a key counts as held for the timeout after it was last heard.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codesign_policy.task import ACTION_NAMES, ControlAction

TIMEOUT = 0.2  # s
NONE = -1  # as the number of an axis or button: there is none for this
ROUNDING = 1e-3  # beyond [-1, 1], of drivers
WIDTH = ACTION_NAMES.index("dw")

FINISH_KEY = "\n"
STILL_KEY = " "  # held: zero actions, as with the dead-man button alone
KEYS = {
    "w": ("dx", 1.0), "s": ("dx", -1.0), "a": ("dy", 1.0), "d": ("dy", -1.0),
    "r": ("dz", 1.0), "f": ("dz", -1.0), "u": ("rx", 1.0), "o": ("rx", -1.0),
    "i": ("ry", 1.0), "k": ("ry", -1.0), "j": ("rz", 1.0), "l": ("rz", -1.0),
    "v": ("dw", 1.0), "c": ("dw", -1.0),
}  # fmt: skip


@dataclass(frozen=True)
class JoyMapping:
    """Which axis and button does what; the defaults suit an Xbox controller under `joy_node`.

    Attributes:
        axes: for each of `ACTION_NAMES`, the number of its axis, or `NONE`.
        gains: of these axes, -1 to 1; 1 reaches the limit of one action.
        hold: the dead-man button.
        close, open: buttons for the gap; `NONE`: it has an axis.
        finish: the button that says that the demonstration is over.
        dead_zone: part of each axis around its middle that counts as zero.
        gap_speed: of buttons and keys for the gap, as part of the limit of one action.
        key_speed: of all other keys, likewise.
    """

    axes: tuple[int, ...] = (1, 0, 4, NONE, NONE, 3, NONE)
    gains: tuple[float, ...] = (1.0,) * 7
    hold: int = 4
    close: int = 0
    open: int = 1
    finish: int = 7
    dead_zone: float = 0.1
    gap_speed: float = 0.4
    key_speed: float = 0.5

    def __post_init__(self) -> None:
        used = [self.hold, self.close, self.open, self.finish]
        if len(self.axes) != 7 or len(self.gains) != 7 or min(*self.axes, *used) < NONE:
            raise ValueError(
                f"axes {self.axes}, gains {self.gains}, buttons {used}: give 7 axes and gains, "
                f"numbers from 0 on, or {NONE} for none"
            )
        if self.hold < 0:
            raise ValueError("there is no dead-man button: name one as `hold`")
        if not (0.0 <= self.dead_zone < 1.0 and all(abs(gain) <= 1.0 for gain in self.gains)):
            raise ValueError(
                f"dead zone {self.dead_zone}, gains {self.gains}: must be 0 to 1, and within 1"
            )
        if not (0.0 < self.gap_speed <= 1.0 and 0.0 < self.key_speed <= 1.0):
            raise ValueError(
                f"gap speed {self.gap_speed}, key speed {self.key_speed}: must be within 0 to 1"
            )

    @property
    def sizes(self) -> tuple[int, int]:
        """How many axes and buttons a message must have at least."""
        return 1 + max(self.axes), 1 + max(self.hold, self.close, self.open, self.finish)

    def normalised(
        self, axes: NDArray[np.float64], buttons: NDArray[np.int_]
    ) -> NDArray[np.float64]:
        """What sticks and gap buttons ask for, (7,) in [-1, 1]."""
        size = np.abs(axes)
        beyond = np.clip((size - self.dead_zone) / (1.0 - self.dead_zone), 0.0, 1.0)
        sticks = np.sign(axes) * beyond
        asked = np.array(
            [
                0.0 if axis == NONE else gain * sticks[axis]
                for axis, gain in zip(self.axes, self.gains, strict=True)
            ]
        )
        for button, direction in ((self.open, 1.0), (self.close, -1.0)):
            if button != NONE and buttons[button]:
                asked[WIDTH] += direction * self.gap_speed
        return np.clip(asked, -1.0, 1.0)


class Teleoperation:
    """Turns joystick messages and keys into actions; times are of any steady clock [s].

    Attributes:
        rejected: joystick messages that were refused.
        finished: somebody said that the demonstration is over.
    """

    def __init__(self, mapping: JoyMapping | None = None, timeout: float = TIMEOUT) -> None:
        """Args: the mapping; for how long a message or a key holds [s]."""
        self.mapping, self._timeout = mapping or JoyMapping(), timeout
        self.rejected = 0
        self.reset()

    def reset(self) -> None:
        """Begins a demonstration: nothing is pressed, nothing finished."""
        self.finished = False
        self._joy: tuple[NDArray[np.float64], NDArray[np.int_]] | None = None
        self._joy_at = -np.inf
        self._keys: dict[str, float] = {}

    def on_joy(self, axes: Sequence[float], buttons: Sequence[int], now: float) -> None:
        """Takes one message of a joystick.

        Raises:
            ValueError: too few axes or buttons, or an axis that is not finite or beyond [-1, 1].
                It is counted, and the message before it no longer holds.
        """
        self._joy = None
        values, pressed = np.asarray(axes, np.float64), np.asarray(buttons, np.int_)
        least = self.mapping.sizes
        if len(values) < least[0] or len(pressed) < least[1]:
            self.rejected += 1
            raise ValueError(
                f"joystick with {len(values)} axes and {len(pressed)} buttons: the mapping needs "
                f"{least[0]} and {least[1]}"
            )
        bad = np.flatnonzero(~(np.abs(values) <= 1.0 + ROUNDING))  # so that NaN counts as bad
        if len(bad):
            self.rejected += 1
            raise ValueError(f"axis {bad[0]} is {values[bad[0]]}: must be within [-1, 1]")
        self._joy, self._joy_at = (values, pressed), now
        finish = self.mapping.finish
        self.finished = self.finished or (finish != NONE and bool(pressed[finish]))

    def on_key(self, key: str, now: float) -> None:
        """Takes one key from a terminal; those without a meaning are ignored."""
        if key in KEYS or key == STILL_KEY:
            self._keys[key] = now
        self.finished = self.finished or key == FINISH_KEY

    def action(self, now: float) -> ControlAction | None:
        """What to do in the next control step; None: send nothing."""
        keys = [key for key, at in self._keys.items() if now - at <= self._timeout]
        held = self._held(now)
        if self.finished or not (keys or held):
            return None
        asked = self.mapping.normalised(*self._joy) if held and self._joy else np.zeros(7)
        for key in keys:
            name, direction = KEYS.get(key, ("dx", 0.0))
            speed = self.mapping.gap_speed if name == "dw" else self.mapping.key_speed
            asked[ACTION_NAMES.index(name)] += direction * speed
        return ControlAction.from_normalised(asked)

    def silence(self, now: float) -> str:
        """Why nothing is sent now."""
        if self.finished:
            return "finished"
        if self._joy is None or now - self._joy_at > self._timeout:
            return f"no joystick message within {self._timeout:g} s and no key"
        return f"dead-man button {self.mapping.hold} is not pressed"

    def _held(self, now: float) -> bool:
        if self._joy is None or now - self._joy_at > self._timeout:
            return False
        return bool(self._joy[1][self.mapping.hold])
