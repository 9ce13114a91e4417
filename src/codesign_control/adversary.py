"""The worst streams of actions that we can think of, and what the servo makes of them.

Also with the arm's driver behind it, up to what would be on the wire.
"""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from codesign_control.clearance import Clearance
from codesign_control.config import ServoConfig
from codesign_control.driver import CommandRefused, box_log
from codesign_control.driver.rehearsal import Rehearsal
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
HOSTILE_SET_POINTS = 0.05  # per tick, at the driver's own door


@dataclass
class Outcome:
    """What a run found; `limits` is None before the first episode.

    wire: with a driver, what must never be on the wire and was.
    """

    limits: LimitReport | None = None
    wire: list[str] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    limit_ticks: Counter[str] = field(default_factory=Counter)
    slowest_stop_s: float = 0.0
    simulated_s: float = 0.0  # with a driver
    starts_refused: int = 0

    @property
    def violations(self) -> int:
        """Of every limit together."""
        return len(self.wire) + (self.limits.violations if self.limits else 0)

    def to_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        checked = self.limits.to_dict() if self.limits else {}
        return checked | {
            "violations": self.violations,
            "wire_violations": len(self.wire),
            "first_wire_violations": self.wire[:5],
            **self.counts,
            "slowest_stop_s": round(self.slowest_stop_s, 3),
            "simulated_s": round(self.simulated_s, 1),
            "starts_refused": self.starts_refused,
            "ticks_at_limit": dict(self.limit_ticks),
        }


def run(
    actions: int,
    seed: int,
    config: ServoConfig | None = None,
    progress: Callable[[int, Outcome], None] | None = None,
    *,
    through_driver: bool = False,
    box_log_file: Path | None = None,
) -> Outcome:
    """Sends `actions` hostile actions to a servo and checks every set-point that comes out.

    progress: called after every episode with the number of actions and the outcome so far.
    through_driver: the set-points go on to the arm's driver, and what it would put on the wire is
    checked: every limit of the servo, and what a control box must never see. box_log_file: then
    gets that, a JSON line per point.
    Equal arguments give equal results. The arm follows every set-point exactly.
    """
    random, outcome, arm = np.random.default_rng(seed), Outcome(), Xarm7()
    config = config or ServoConfig()
    servos = [CartesianServo(arm, config, hand) for hand in _hands()]
    hands = _hands()
    done = 0
    if box_log_file:
        box_log_file.write_text("")
    while done < actions:
        which = int(random.integers(len(servos)))
        follower = Driven(random, outcome, box_log_file) if through_driver else Exact()
        episode = Episode(servos[which], hands[which], random, outcome, follower)
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


class Follower(Protocol):
    """What is behind the servo.

    reached: the last posture that the arm was sent to, (7,) [rad].
    ticks_to_begin: of standing set-points that it wants to see before it moves.
    """

    ticks_to_begin: int

    @property
    def reached(self) -> np.ndarray: ...

    def place(self, posture: np.ndarray) -> np.ndarray:
        """Puts the arm there; the posture (7,) [rad] that it then measures."""

    def follow(self, output: ServoOutput) -> np.ndarray:
        """One tick; what the arm measures then."""

    def gripper_target(self, target: float) -> float:
        """Once a tick: the gap [m] that the gripper is told, when the servo says `target`."""

    def close(self) -> None:
        """After the last tick."""


class Exact:
    """An arm that is where each set-point sends it."""

    ticks_to_begin = 0

    def __init__(self) -> None:
        self.reached = np.zeros(7)

    def place(self, posture: np.ndarray) -> np.ndarray:
        """As Follower."""
        self.reached = posture
        return posture

    def follow(self, output: ServoOutput) -> np.ndarray:
        """As Follower."""
        self.reached = output.position
        return output.position

    def gripper_target(self, target: float) -> float:
        """As Follower."""
        return target

    def close(self) -> None:
        """As Follower."""


class Driven:
    """The arm's driver on a simulated clock, with somebody who sends it rubbish as well."""

    ticks_to_begin = 10  # two are enough, but rubbish may come between

    def __init__(
        self, random: np.random.Generator, outcome: Outcome, log: Path | None = None
    ) -> None:
        self._random, self._outcome, self._log = random, outcome, log
        self._rehearsal = Rehearsal()
        # s, of a set-point when the driver wakes: two clocks of one rate.
        config = self._rehearsal.config
        self._age = float(random.uniform(0.0, config.period))
        self._targets: deque[float] = deque(maxlen=1 + round(config.delay / config.period))

    @property
    def reached(self) -> np.ndarray:
        """Before the wire's single precision, whose last digits would show in the jerk."""
        return self._rehearsal.sent

    def place(self, posture: np.ndarray) -> np.ndarray:
        """As Follower."""
        self._rehearsal.place(posture)
        return self._rehearsal.measured.position

    def follow(self, output: ServoOutput) -> np.ndarray:
        """As Follower."""
        rehearsal = self._rehearsal
        if self._random.random() < HOSTILE_SET_POINTS:
            self._send(*self._hostile())
            self._outcome.counts["set_points_hostile"] += 1
        if output.active:
            self._send(output.position, rehearsal.now - self._age)
            self._outcome.counts["set_points_to_the_driver"] += 1
        rehearsal.tick()
        return self._rehearsal.measured.position

    def gripper_target(self, target: float) -> float:
        """As Follower: as soon as the driver's gripper thread may send it, which seldom does."""
        self._targets.append(target)
        return self._targets[0]

    def _send(self, position: object, moment: float) -> None:
        try:
            self._rehearsal.driver.command(position, moment)
        except CommandRefused:
            return

    def _hostile(self) -> tuple[object, float]:
        """A set-point and its moment, of which at least one is none."""
        near, now = self._rehearsal.sent, self._rehearsal.now
        joint = np.eye(7)[self._random.integers(7)]
        between = now - self._age - self._rehearsal.config.period / 2.0
        jump = self._random.choice([-1.0, 1.0]) * self._random.uniform(0.1, 3.0)
        cases: tuple[tuple[object, float], ...] = (
            (near + np.nan * joint, between),
            (near + np.inf * joint, between),
            (near + 1e30 * joint, between),
            (near + jump * joint, between),
            (near[:6], between),
            (near, now - 0.5),
            (near, now + 0.5),
            (near, np.nan),
        )
        return cases[self._random.integers(len(cases))]

    def close(self) -> None:
        """Checks what was on the wire."""
        status, counts = self._rehearsal.driver.status(), self._outcome.counts
        counts["points_on_the_wire"] += status.points_sent
        counts["points_held"] += status.points_held
        counts["pauses"] += status.pauses
        counts.update({f"refused_{reason}": n for reason, n in status.refused.items()})
        records, config = self._rehearsal.records, self._rehearsal.config
        self._outcome.wire += box_log.violations(records, config.largest_step)
        begin = self._outcome.simulated_s + 1.0  # after a pause, as the box's clock goes on
        self._outcome.simulated_s = begin + self._rehearsal.now
        if self._log:
            with self._log.open("a") as file:
                for record in records:
                    file.write(json.dumps(record | {"t": begin + record["t"]}) + "\n")


class Episode:
    """One start of a servo, a stream of actions, and the check of all that came out."""

    def __init__(
        self,
        servo: CartesianServo,
        hand: Hand,
        random: np.random.Generator,
        outcome: Outcome,
        follower: Follower,
    ) -> None:
        self._follower = follower
        self._servo, self._hand, self._random, self._outcome = servo, hand, random, outcome
        self._clearance = Clearance(servo.config, hand)
        self._arm = Xarm7()
        self._now, self._width_target = 0.0, hand.gripper.max_width
        self._gripper = GripperModel(hand.gripper.protrusion, width=0.06)
        self._position = self._start()
        self._log = [follower.reached] * 4
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
            start = self._follower.place(start)
            try:
                self._servo.enable(start, self._now)
            except MoveRejected:
                self._outcome.starts_refused += 1
                continue
            return start

    def run(self, actions: int) -> None:
        """Sends that many actions, waits for the stop, disables, checks."""
        self._step(self._follower.ticks_to_begin)
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
        self._follower.close()
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
            self._output, self._position = output, self._follower.follow(output)
            self._now += self._servo.config.period
            self._log.append(self._follower.reached)
            target = self._gripper.width if output.gripper is None else output.gripper
            target = self._follower.gripper_target(target)
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
            self._step(self._follower.ticks_to_begin)

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
