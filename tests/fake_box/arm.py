"""The arm inside the fake box: joints that follow, modes, states and errors of the firmware."""

import math
from dataclasses import dataclass, field

import numpy as np

HOME = (0.0, -0.0909228, 0.0, 1.1301161, 0.0, 1.2210390, 0.0)  # rad
TIME_CONSTANT = 0.008  # s, lag of the joints behind a servo point
MAX_SPEED = math.pi  # rad/s, the speed at which servo mode runs to a point
STOPPED, READY, MOVING, JUST_RESET = 4, 2, 1, 5  # states in reports
SERVO_MODE = 1
EMERGENCY_STOPS = (1, 2, 3)


@dataclass
class Arm:
    """Joints (7,) [rad]: first-order lag behind the last servo point, limited in speed."""

    joints: np.ndarray = field(default_factory=lambda: np.array(HOME))
    mode: int = 0
    state: int = STOPPED
    enabled: bool = False
    error: int = 0
    warning: int = 0
    error_held: bool = False  # an emergency stop that is still pressed
    points: int = 0  # servo points carried out

    def __post_init__(self) -> None:
        self.target = self.joints.copy()
        self._time: float | None = None

    def advance(self, now: float) -> None:
        """Moves the joints on to a moment [s, any steady clock]."""
        elapsed = 0.0 if self._time is None else now - self._time
        self._time = now
        if elapsed <= 0.0 or not self.can_move:
            return
        step = (self.target - self.joints) * (1.0 - math.exp(-elapsed / TIME_CONSTANT))
        self.joints = self.joints + np.clip(step, -MAX_SPEED * elapsed, MAX_SPEED * elapsed)
        moving = bool(np.abs(self.target - self.joints).max() > 1e-5)
        self.state = MOVING if moving else READY

    @property
    def can_move(self) -> bool:
        return self.enabled and self.error == 0 and self.state in (0, MOVING, READY)

    @property
    def status(self) -> int:
        """The state byte of every reply: 0x40 error, 0x20 warning, 0x10 not ready to move."""
        return (
            (0x40 if self.error else 0) | (0x20 if self.warning else 0)
            | (0 if self.can_move else 0x10)
        )  # fmt: skip

    def servo(self, joints: np.ndarray) -> bool:
        """Takes a servo point (7,) [rad]; False when the arm does not carry it out."""
        if not (self.can_move and self.mode == SERVO_MODE):
            return False
        # What the firmware does with NaN is unknown; here it is never carried out.
        if not np.isfinite(joints).all():
            return False
        self.target = joints
        self.points += 1
        return True

    def fail(self, error: int, held: bool = False) -> None:
        """Raises an error: the arm stops where it is, at once."""
        self.error, self.error_held = error, held
        self.state = STOPPED
        self.target = self.joints.copy()
        if error in EMERGENCY_STOPS:
            self.enabled = False

    def clear_error(self) -> None:
        """Clears the error unless its cause is still there."""
        if not self.error_held:
            self.error = 0

    def set_mode(self, mode: int) -> None:
        self.mode = mode
        self.state = JUST_RESET if self.error == 0 else STOPPED

    def set_state(self, state: int) -> None:
        """0: ready to move; 3: pause; 4: stop."""
        self.target = self.joints.copy()
        if state == 0:
            self.state = READY if self.error == 0 and self.enabled else STOPPED
        else:
            self.state = state
