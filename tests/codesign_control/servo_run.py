"""Drives a servo in the tests and measures its set-points from the outside."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from codesign_control import CartesianServo, ServoConfig, ServoOutput, Xarm7

STILL = np.zeros(3)
# Outputs are doubles: third differences at 0.01 s magnify their last digit by 1e6.
SLACK = 1e-6


class Run:
    """A servo with a perfectly following arm, its time and all set-points so far."""

    def __init__(
        self,
        arm: Xarm7,
        config: ServoConfig | None = None,
        start: np.ndarray | None = None,
    ) -> None:
        self.arm = arm
        self.servo = CartesianServo(arm, config)
        self.now = 100.0
        self.start = np.array(arm.home if start is None else start)
        self.position = self.start
        self.outputs: list[ServoOutput] = []
        self.servo.enable(self.start, self.now)

    def step(self, ticks: int = 1) -> ServoOutput:
        """`ticks` control periods without a new action; the last output."""
        for _ in range(ticks):
            output = self.servo.step(self.position, self.now)
            self.now += self.servo.config.period
            self.position = output.position
            self.outputs.append(output)
        return self.outputs[-1]

    def act(self, translation: np.ndarray, rotation: np.ndarray = STILL) -> ServoOutput:
        """One action and the control periods until the next one is due."""
        self.servo.submit(translation, rotation, self.now)
        return self.step(round(self.servo.config.action_period / self.servo.config.period))

    def joints(self) -> np.ndarray:
        """(n, 7) rad: the start, twice more in front of it, and all set-points."""
        still = [self.start] * 3
        return np.array(still + [output.position for output in self.outputs])

    def tcp(self) -> np.ndarray:
        """(n, 3) m: positions of link_tcp along `joints`."""
        return np.array([self.arm.tcp_placement(q).translation for q in self.joints()])

    def assert_within_limits(self) -> None:
        """Every limit, from the set-points' own finite differences."""
        config, dt = self.servo.config, self.servo.config.period
        q, tcp = self.joints(), self.tcp()
        assert np.isfinite(q).all()
        assert (q >= self.arm.lower).all()
        assert (q <= self.arm.upper).all()
        assert (tcp >= config.box_lower).all()
        assert (tcp <= config.box_upper).all()
        for order, limit in enumerate(
            (config.joint_velocity, config.joint_acceleration, config.joint_jerk), start=1
        ):
            assert np.abs(np.diff(q, order, axis=0)).max() / dt**order <= limit * (1 + SLACK)
        speed = np.linalg.norm(np.diff(tcp, axis=0), axis=1).max() / dt
        assert speed <= config.tcp_speed_limit * (1 + SLACK)
        for output in self.outputs:
            assert np.abs(output.velocity).max() <= config.joint_velocity * (1 + SLACK)
            assert np.abs(output.acceleration).max() <= config.joint_acceleration * (1 + SLACK)


def direction(random: np.random.Generator) -> np.ndarray:
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)


def hostile(
    pattern: str, random: np.random.Generator, config: ServoConfig
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """An endless stream of actions at the limit of one action."""
    far, turn = config.action_translation, config.action_rotation
    along, about, count = direction(random), direction(random), 0
    while True:
        count += 1
        if pattern == "push":  # into a limit and on
            yield far * along, turn * about
        elif pattern == "slide":
            yield far * along, STILL
        elif pattern == "turn":
            yield STILL, turn * about
        elif pattern == "shake":
            sign = -1.0 if count % 2 else 1.0
            yield sign * far * along, sign * turn * about
        elif pattern == "sawtooth":
            sign = -1.0 if count // 7 % 2 else 1.0
            yield sign * far * along, sign * turn * about
        elif pattern == "wander":
            if count % 23 == 0:
                along, about = direction(random), direction(random)
            yield far * along, turn * about
        elif pattern == "noise":
            yield far * random.random() * direction(random), turn * direction(random)
        else:
            raise ValueError(pattern)


PATTERNS = ("push", "slide", "turn", "shake", "sawtooth", "wander", "noise")
