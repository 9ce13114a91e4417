"""The worst streams of actions that we can think of, and what the servo makes of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from codesign_control.clearance import Clearance
from codesign_control.config import ServoConfig
from codesign_control.finger_reach import FingerReach
from codesign_control.gripper import GripperModel
from codesign_control.hand import STOCK_BOX, Hand
from codesign_control.limit_check import LimitReport, check_log
from codesign_control.servo import (
    ActionRejected,
    CartesianServo,
    MoveRejected,
    ServoOutput,
    ServoState,
)
from codesign_control.xarm7 import Xarm7

EPISODE = 4000  # actions between two starts
STOP_TICKS = 30  # the arm has to stand 0.3 s after the last action
Action = tuple[np.ndarray, np.ndarray]  # translation (3,) m, rotation (3,) rad
RUBBISH: tuple[Action, ...] = (
    (np.array([np.nan, 0.0, 0.0]), np.zeros(3)),
    (np.zeros(3), np.array([0.0, np.nan, 0.0])),
    (np.array([0.0, np.inf, 0.0]), np.zeros(3)),
    (np.zeros(3), np.full(3, -np.inf)),
    (np.full(3, 1e300), np.zeros(3)),
    (np.zeros(3), np.array([0.0, 0.0, 1e6])),
    (np.array([0.0, 0.0, -0.0126]), np.zeros(3)),
    (np.zeros(2), np.zeros(3)),
    (np.zeros(3), np.zeros(0)),
)
# How actions come: ticks per action, or actions per tick when negative; and how often.
TEMPOS = ((5, 0.02), (1, 0.1), (-20, 0.88))


@dataclass
class Outcome:
    """What a run found; `limits` is None before the first episode."""

    limits: LimitReport | None = None
    counts: Counter[str] = field(default_factory=Counter)
    limit_ticks: Counter[str] = field(default_factory=Counter)
    slowest_stop_s: float = 0.0
    starts_refused: int = 0

    def to_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        checked = self.limits.to_dict() if self.limits else {}
        return checked | {
            **self.counts,
            "slowest_stop_s": round(self.slowest_stop_s, 3),
            "starts_refused": self.starts_refused,
            "ticks_at_limit": dict(self.limit_ticks),
        }


def run(
    actions: int,
    seed: int,
    config: ServoConfig | None = None,
    progress: Callable[[int, Outcome], None] | None = None,
) -> Outcome:
    """Sends `actions` hostile actions to a servo and checks every set-point that comes out.

    progress: called after every episode with the number of actions and the outcome so far.
    Equal arguments give equal results. The arm follows every set-point exactly.
    """
    random, outcome, arm = np.random.default_rng(seed), Outcome(), Xarm7()
    config = config or ServoConfig()
    servos = [CartesianServo(arm, config, hand) for hand in _hands()]
    hands = _hands()
    done = 0
    while done < actions:
        which = int(random.integers(len(servos)))
        episode = Episode(servos[which], hands[which], random, outcome)
        episode.run(min(EPISODE, actions - done))
        done += min(EPISODE, actions - done)
        if progress:
            progress(done, outcome)
    for servo in servos:
        outcome.limit_ticks.update(servo.limit_ticks)
        outcome.counts.update(vars(servo.counters))
    return outcome


def _hands() -> list[Hand]:
    """Stock fingers, long ones that reach below the TCP, and wide ones."""
    long = STOCK_BOX + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.03]])
    wide = STOCK_BOX + np.array([[-0.02, 0.0, 0.0], [0.02, 0.012, 0.01]])
    return [Hand(), *(Hand(GripperModel(), _box_fingers(box)) for box in (long, wide))]


def _box_fingers(box: np.ndarray) -> FingerReach:
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    return FingerReach(corners, corners * [1.0, -1.0, 1.0])


class Episode:
    """One start of a servo, a stream of actions, and the check of all that came out."""

    def __init__(
        self, servo: CartesianServo, hand: Hand, random: np.random.Generator, outcome: Outcome
    ) -> None:
        self._servo, self._hand, self._random, self._outcome = servo, hand, random, outcome
        self._clearance = Clearance(servo.config, hand)
        self._arm = Xarm7()
        self._now, self._width_target = 0.0, hand.gripper.max_width
        self._gripper = GripperModel(hand.gripper.protrusion, width=0.06)
        self._position = self._start()
        self._log = [self._position] * 4
        self._widths = [(0.06, 0.06)] * 4
        self._output: ServoOutput | None = None

    def _start(self) -> np.ndarray:
        """Enables the servo near home or anywhere else where it lets itself be enabled."""
        arm, random = self._arm, self._random
        anywhere = random.random() < 0.5
        self._servo.observe_gripper(self._gripper.width)
        while True:
            if anywhere:
                start = random.uniform(np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0))
            else:
                start = arm.home + 0.3 * random.normal(size=7)
            try:
                self._servo.enable(start, self._now)
            except MoveRejected:
                self._outcome.starts_refused += 1
                continue
            return start

    def run(self, actions: int) -> None:
        """Sends that many actions, waits for the stop, disables, checks."""
        sent = 0
        while sent < actions:
            stream = self._stream()
            tempo = self._tempo()
            for _ in range(min(actions - sent, int(self._random.integers(20, 400)))):
                self._send(next(stream))
                sent += 1
                if tempo > 0:
                    self._step(tempo)
                elif self._random.random() < -1.0 / tempo:
                    self._step(1)
            if self._random.random() < 0.2:
                self._step(int(self._random.integers(1, 60)))
            if self._random.random() < 0.05:
                self._interfere()
        self._stop()
        self._check()

    def _tempo(self) -> int:
        # Shares are of the actions; every stretch has as many.
        tempos, shares = zip(*TEMPOS, strict=True)
        return int(self._random.choice(tempos, p=shares))

    def _send(self, action: Action) -> None:
        if self._random.random() < 0.05:
            action = RUBBISH[self._random.integers(len(RUBBISH))]
        self._outcome.counts["actions"] += 1
        try:
            self._servo.submit(*action, self._now)
        except ActionRejected:
            return
        low, high = self._hand.width_range
        if self._random.random() < 0.3:
            change = self._random.choice([-0.005, 0.005])
            self._width_target = min(max(self._width_target + change, low), high)
            self._servo.ask_gripper(self._width_target)

    def _step(self, ticks: int) -> None:
        for _ in range(ticks):
            self._servo.observe_gripper(self._gripper.width)
            output = self._servo.step(self._position, self._now)
            self._output, self._position = output, output.position
            self._now += self._servo.config.period
            self._log.append(output.position)
            target = self._gripper.width if output.gripper is None else output.gripper
            self._widths.append((self._gripper.width, target))
            self._gripper.step(target, self._servo.config.period, 0.2)

    def _interfere(self) -> None:
        """What operators do in the middle of it."""
        kind = self._random.integers(4)
        if kind == 0:
            self._servo.disable()
        elif kind == 1:
            self._servo.fault("injected")
        elif kind == 2:
            self._step(STOP_TICKS)
            try:
                goal = self._position + 0.3 * self._random.normal(size=7)
                self._servo.move_to(goal, self._now, 1.0)
            except MoveRejected:
                self._outcome.counts["moves_refused"] += 1
        self._step(STOP_TICKS)
        self._servo.cancel()
        self._step(STOP_TICKS)
        if self._servo.state is ServoState.FAULT:
            self._servo.reset_fault(self._position, self._now)
        if self._servo.state is ServoState.DISABLED:
            self._servo.enable(self._position, self._now)

    def _stop(self) -> None:
        """Silence: how long until it stands."""
        moving = 0
        for tick in range(1, 2 * STOP_TICKS):
            self._step(1)
            if self._output is not None and self._output.velocity.any():
                moving = tick
        stopped = moving * self._servo.config.period
        self._outcome.slowest_stop_s = max(self._outcome.slowest_stop_s, stopped)
        if self._servo.state is ServoState.FAULT:
            self._servo.reset_fault(self._position, self._now)
        self._servo.disable()
        self._step(2)

    def _check(self) -> None:
        log, widths = np.array(self._log), np.array(self._widths)
        times = self._servo.config.period * np.arange(len(log))
        config, known = self._servo.config, self._outcome.limits
        report = check_log(times, log, config, self._hand, widths[:, 0])
        # The gap that the gripper goes to counts like the one that it has.
        other = check_log(times, log, config, self._hand, widths[:, 1])
        name = "finger height"
        report = report.merged(LimitReport(0, {name: other.findings[name]}))
        self._outcome.limits = known.merged(report) if known else report

    # Streams -------------------------------------------------------------------------------------

    def _stream(self) -> Iterator[Action]:
        kinds = (self._along, self._swing, self._noise, self._pushing, self._down, self._corner)
        return kinds[self._random.integers(len(kinds))]()

    def _full(self, twist: np.ndarray) -> Action:
        """An action along a (6,) twist, as large as one action may be."""
        config = self._servo.config
        moved, turned = np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])
        size = max(moved / config.action_translation, turned / config.action_rotation, 1e-12)
        return twist[:3] / size, twist[3:] / size

    def _along(self) -> Iterator[Action]:
        """One way, into whatever is there."""
        twist = self._random.normal(size=6) * [1, 1, 1, 4, 4, 4]
        while True:
            yield self._full(twist)

    def _swing(self) -> Iterator[Action]:
        """To and fro: a sawtooth of 1 to 15 actions."""
        twist, half = self._random.normal(size=6) * [1, 1, 1, 4, 4, 4], self._random.integers(1, 16)
        count = 0
        while True:
            yield self._full(twist if count // half % 2 else -twist)
            count += 1

    def _noise(self) -> Iterator[Action]:
        while True:
            yield self._full(self._random.normal(size=6) * [1, 1, 1, 4, 4, 4])

    def _down(self) -> Iterator[Action]:
        """Onto the table, tilting."""
        tilt = 3.0 * self._random.normal(size=3) * self._random.integers(2)
        while True:
            yield self._full(np.array([0.0, 0.0, -1.0, *tilt]))

    def _corner(self) -> Iterator[Action]:
        """Into a corner of the box."""
        config = self._servo.config
        corner = np.where(self._random.random(3) < 0.5, config.box_lower, config.box_upper)
        while True:
            away = corner - self._arm.tcp_placement(self._position).translation
            yield self._full(np.concatenate([away, np.zeros(3)]))

    def _pushing(self) -> Iterator[Action]:
        """Towards a singularity, the arm itself or the end of a joint, downhill."""
        measure = (self._smallest_singular, self._least_room, self._joint_room)[
            self._random.integers(3)
        ]
        while True:
            q = self._position
            here = measure(q)
            slope = np.array([(measure(q + 1e-6 * unit) - here) / 1e-6 for unit in np.eye(7)])
            action = self._full(-self._arm.jacobian_tcp(q) @ slope)
            for _ in range(20):
                yield action

    def _smallest_singular(self, q: np.ndarray) -> float:
        return float(np.linalg.svd(self._arm.jacobian_tcp(q), compute_uv=False)[-1])

    def _least_room(self, q: np.ndarray) -> float:
        return float(self._clearance.room(q)[: self._clearance.self_pairs].min())

    def _joint_room(self, q: np.ndarray) -> float:
        return float(np.minimum(q - self._arm.lower, self._arm.upper - q).min())
