"""What the driver refuses, and that nothing it lets through breaks a limit: no arm, no clock."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_control import Xarm7
from codesign_control.driver import (
    REASONS,
    ClockMap,
    CommandChecks,
    CommandRefused,
    CommandStream,
    DeadlineLoop,
    DriverConfig,
    Measured,
)
from codesign_control.xarm7 import HOME

CONFIG = DriverConfig()
LOWER, UPPER = np.array(CONFIG.joint_lower), np.array(CONFIG.joint_upper)
PERIOD = 0.01  # s between commands


def reason_of(checks: CommandChecks, position: Any, moment: float = 10.0, now: float = 10.0) -> str:
    with pytest.raises(CommandRefused) as refusal:
        checks.check(position, moment, now)
    assert str(refusal.value) == checks.last_refusal
    return refusal.value.reason


def test_the_limits_are_the_arms() -> None:
    arm = Xarm7()  # its URDF rounds them to a milliradian
    np.testing.assert_allclose(LOWER, arm.lower, atol=5e-4)
    np.testing.assert_allclose(UPPER, arm.upper, atol=5e-4)


@pytest.mark.parametrize(
    ("position", "reason"),
    [
        ([], "wrong_length"),
        ([0.0] * 6, "wrong_length"),
        ([0.0] * 8, "wrong_length"),
        ([[0.0] * 7], "wrong_length"),
        (None, "wrong_length"),
        ("joints", "wrong_length"),
        ([*HOME[:6], math.nan], "not_finite"),
        ([math.inf, *HOME[1:]], "not_finite"),
        ([-math.inf] * 7, "not_finite"),
        ([0.0, 2.1, 0.0, 1.0, 0.0, 0.0, 0.0], "outside_limits"),
        ([0.0, 0.0, 0.0, -0.2, 0.0, 0.0, 0.0], "outside_limits"),
        ([1e30] * 7, "outside_limits"),
    ],
)
def test_nonsense_is_refused_and_counted(position: Any, reason: str) -> None:
    checks = CommandChecks(CONFIG)
    assert reason_of(checks, position) == reason
    assert checks.refused == {reason: 1}


@pytest.mark.parametrize(
    ("moment", "reason"),
    [(9.8, "stale"), (-1e9, "stale"), (10.3, "wrong_clock"), (60.0, "wrong_clock"),
     (math.nan, "wrong_clock"), (math.inf, "wrong_clock")],
)  # fmt: skip
def test_old_and_future_commands_are_refused(moment: float, reason: str) -> None:
    assert reason_of(CommandChecks(CONFIG), HOME, moment) == reason


def test_jumps_and_disorder_are_refused_and_good_ones_go_on() -> None:
    checks = CommandChecks(CONFIG)
    checks.check(HOME, 10.0, 10.0)
    assert reason_of(checks, HOME + 0.0155, 10.01) == "too_fast"
    assert reason_of(checks, HOME + 3.0, 10.01) == "outside_limits"
    assert reason_of(checks, HOME, 10.0) == "out_of_order"
    assert reason_of(checks, HOME, 9.99) == "out_of_order"
    np.testing.assert_array_equal(checks.check(HOME + 0.0149, 10.01, 10.0), HOME + 0.0149)
    # A long gap is no leave for a long way.
    assert reason_of(checks, HOME + 0.2, 10.15) == "too_fast"
    checks.forget()
    checks.check(HOME + 0.2, 10.15, 10.1)


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=9), st.floats())
def test_whatever_passes_is_seven_angles_inside_the_limits(values: Any, moment: float) -> None:
    checks = CommandChecks(CONFIG)
    try:
        joints = checks.check(values, moment, 10.0)
    except CommandRefused:
        assert set(checks.refused) <= set(REASONS)
        return
    assert joints.shape == (7,)
    assert (joints >= LOWER).all()
    assert (joints <= UPPER).all()
    assert 9.85 <= moment <= 10.2


# --- the stream: what comes out, for any input


class Player:
    """Feeds a stream on a simulated clock and holds every point against the limits."""

    def __init__(self, rate: int = 100) -> None:
        self.config = DriverConfig(rate=rate)
        self.stream = CommandStream(self.config)
        self.now = 100.0
        self.arm = HOME.copy()
        self.points: list[np.ndarray] = []
        self.violations: list[str] = []
        self._was_playing = False

    def send(self, position: Any, moment: float | None = None) -> bool:
        try:
            self.stream.command(position, self.now if moment is None else moment, self.now)
        except CommandRefused:
            return False
        return True

    def tick(self) -> None:
        self.now += self.config.period
        measured = Measured(self.now, self.arm, np.zeros(7))
        was_playing = self.stream.playing
        point = self.stream.tick(self.now, measured)
        if point is None:
            return
        reference = self.points[-1] if was_playing and self.points else self.arm
        step = np.abs(point - reference).max()
        if not np.isfinite(point).all() or (point < LOWER).any() or (point > UPPER).any():
            self.violations.append(f"{point}")
        elif step > self.config.largest_step + 1e-9:
            self.violations.append(f"step {step}")
        self.points.append(point)
        self.arm = point  # it follows at once: the worst case for what `measured` allows

    def hold(self, position: Any, seconds: float) -> None:
        end = self.now + seconds
        due = self.now
        while self.now < end:
            while due <= self.now:
                self.send(position, due)
                due += PERIOD
            self.tick()


@pytest.mark.parametrize("rate", [50, 100, 250])
def test_plays_exactly_what_was_commanded_a_little_later(rate: int) -> None:
    player = Player(rate)
    player.hold(HOME, 0.3)
    assert player.stream.playing
    began, sent, due = player.now, [], player.now
    first = len(player.points)
    while player.now < began + 2.0:
        while due <= player.now:
            sent.append((due, HOME[0] + 0.3 * (1 - math.cos(2 * (due - began)))))
            player.send([sent[-1][1], *HOME[1:]], due)
            due += PERIOD
        player.tick()
    moments = began + np.arange(1, len(player.points) - first + 1) / rate - player.config.delay
    wanted = np.interp(moments, *np.transpose(sent))
    # A linear piece of 10 ms is that far from the curve; nothing else.
    assert np.abs(np.array(player.points[first:])[:, 0] - wanted).max() < 1e-9 + 2e-5
    assert not player.violations


def test_a_motion_that_begins_at_once_is_played_at_its_own_speed() -> None:
    """Nothing to catch up on after the two set-points that matched."""
    player = Player()
    player.hold(HOME, 0.04)
    assert player.stream.playing
    began, first = player.now, len(player.points)
    for k in range(1, 100):
        player.send([HOME[0] + 0.5 * k * PERIOD, *HOME[1:]], began + k * PERIOD)
        player.tick()
    velocity = np.diff(np.array(player.points[first:])[:, 0]) / PERIOD
    assert velocity.max() < 0.5001
    assert velocity[10:] == pytest.approx(0.5, abs=1e-4)
    assert not player.violations


def test_a_stop_is_played_to_its_end_as_it_was_made() -> None:
    """Braking once more before its last set-points would be another motion."""
    player = Player()
    player.hold(HOME, 0.3)
    began, sent = player.now, []
    first = len(player.points)
    for k in range(60):
        s = min(k / 30.0, 1.0)
        sent.append(HOME[0] + 0.02 * s**3 * (10.0 - 15.0 * s + 6.0 * s**2))
        if s < 1.0 or sent[-1] != sent[-2]:  # then silence
            player.send([sent[-1], *HOME[1:]], began + k * PERIOD)
        player.tick()
    played = np.array(player.points[first:])[:, 0]
    late = round(player.config.delay / PERIOD) - 1
    assert played[late : late + 31] == pytest.approx(sent[:31], abs=1e-9)


def test_jitter_of_the_sender_does_not_show() -> None:
    player, random = Player(), np.random.default_rng(0)
    player.hold(HOME, 0.3)
    began, queue, due = player.now, [], player.now
    first = len(player.points)
    while player.now < began + 3.0:
        while due <= player.now:
            queue.append((due + random.uniform(0.0, 0.015), due))  # arrives, is meant for
            due += PERIOD
        while queue and queue[0][0] <= player.now:
            moment = queue.pop(0)[1]
            player.send([HOME[0] + 0.5 * min(moment - began, 2.0), *HOME[1:]], moment)
        player.tick()
    velocity = np.diff(np.array(player.points[first:])[:, 0]) / 0.01
    assert velocity[20:180] == pytest.approx(0.5, abs=1e-6)
    assert not player.violations


def test_a_jump_of_the_stream_pauses_it_and_no_pose_elsewhere_starts_it() -> None:
    player = Player()
    player.hold(HOME, 0.3)
    player.hold(HOME + 0.2, 0.5)
    assert not player.stream.playing
    assert player.stream.checks.refused["too_fast"] > 5
    assert player.stream.checks.refused["no_match"] > 5
    np.testing.assert_allclose(player.points[-1], HOME, atol=1e-9)
    player.hold(HOME, 0.3)
    assert player.stream.playing
    assert not player.violations


hostile = st.one_of(
    st.just([math.nan] * 7),
    st.just([math.inf] * 7),
    st.just([]),
    st.lists(st.floats(-8, 8), min_size=7, max_size=7),
    st.builds(lambda scale, seed: (scale, seed), st.floats(0, 0.1), st.integers(0, 1000)),
)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(hostile, st.floats(-0.3, 0.4), st.integers(1, 4)), max_size=60),
    st.sampled_from([100, 250]),
)
def test_no_stream_of_commands_breaks_a_limit(steps: Any, rate: int) -> None:
    player = Player(rate)
    player.hold(HOME, 0.2)
    assert player.points
    for command, shift, ticks in steps:
        if isinstance(command, tuple):  # near the arm: the ones that may pass
            scale, seed = command
            command = player.arm + np.random.default_rng(seed).normal(size=7) * scale
            shift *= 0.1
        player.send(command, player.now + shift)
        for _ in range(ticks):
            player.tick()
    assert not player.violations


def adversary(player: Player, random: np.random.Generator) -> Any:
    """One command: rubbish, huge, a jump, a sawtooth at the limit, or a limit itself."""
    kind = random.integers(7)
    if kind == 0:
        return [math.nan, math.inf, -math.inf][random.integers(3)] * np.ones(7)
    if kind == 1:
        return random.normal(size=7) * 10.0 ** random.integers(-3, 30)
    if kind == 2:
        return np.where(random.random(7) < 0.5, LOWER, UPPER)
    if kind == 3:
        return player.arm + random.normal(size=7) * 0.3
    return player.arm + random.choice([-1.0, 1.0], 7) * random.uniform(0.0, 0.016)


def attack(commands: int, seed: int) -> Player:
    """Hostile commands on an arm that is held now and then, so that the stream plays."""
    player, random = Player(), np.random.default_rng(seed)
    for k in range(commands):
        if k % 40 == 0:
            player.hold(np.clip(player.arm, LOWER, UPPER), 0.06)
        player.send(adversary(player, random), player.now + random.uniform(-0.02, 0.05))
        if random.random() < 0.7:
            player.tick()
    return player


def test_5_000_adversarial_commands_break_no_limit() -> None:
    player = attack(5_000, seed=1)
    assert len(player.points) > 500
    assert not player.violations
    assert {"not_finite", "outside_limits", "too_fast", "no_match"} <= set(
        player.stream.checks.refused
    )


# --- clocks


def test_a_look_that_takes_long_is_no_jerk() -> None:
    clocks, random = ClockMap(), np.random.default_rng(0)
    moments = []
    for k in range(500):
        wall, steady = 1_000_000_000 * 10**9 + k * 10**7, k * 10**7
        interrupted = int(random.integers(0, 20_000_000)) if random.random() < 0.1 else 0
        moments.append(clocks.steady(wall + 5 * 10**6, wall, steady + interrupted))
    assert np.diff(moments) == pytest.approx(0.01, rel=0.0011)  # 1 % is what the checks allow
    assert clocks.jumps == 0


@pytest.mark.parametrize("jump", [50.0, -50.0])
def test_a_jump_of_the_wall_clock_is_no_motion(jump: float) -> None:
    """The controller's and the driver's wall clock are the same one; one command is between."""
    player, clocks, wall_ahead = Player(), ClockMap(), 0.0
    refused = 0
    for k in range(300):
        stamp = player.now + wall_ahead
        if k == 150:
            wall_ahead += jump
        now = round((player.now + wall_ahead) * 1e9)
        moment = clocks.steady(round(stamp * 1e9), now, round(player.now * 1e9))
        refused += not player.send([HOME[0] + 0.3 * max(0, k - 50) * PERIOD, *HOME[1:]], moment)
        player.tick()
    assert refused == 1
    assert clocks.jumps == 1
    assert player.stream.pauses == 0
    velocity = np.diff(np.array(player.points)[:, 0]) / PERIOD
    assert velocity[80:] == pytest.approx(0.3, abs=0.02)
    assert not player.violations


# --- settings and deadlines


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"rate": 251}, "rate"),
        ({"rate": 10}, "rate"),
        ({"gripper": "g3"}, "gripper"),
        ({"joint_velocity": 0.0}, "joint_velocity"),
        ({"delay": math.nan}, "delay"),
        ({"joint_lower": (0.0,) * 6}, "joint_lower"),
        ({"joint_lower": CONFIG.joint_upper}, "joint_upper"),
        ({"reply_share": 0.9}, "reply_share"),
        ({"gripper_effort": 2.0}, "gripper_effort"),
    ],
)
def test_bad_settings_are_refused(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DriverConfig(**values)


def test_deadlines_stay_on_their_grid_whatever_a_step_takes() -> None:
    import time

    calls: list[float] = []

    def step(now: float) -> None:
        calls.append(now)
        if len(calls) == 10:
            time.sleep(0.055)  # five and a half periods: five are left out

    loop = DeadlineLoop(0.01, step)
    loop.start()
    time.sleep(0.5)
    loop.stop()
    assert loop.missed >= 4
    assert len(loop.deviations()) == len(calls)
    deadlines = np.array(calls) - loop.deviations()
    on_grid = (deadlines - deadlines[0]) / 0.01
    np.testing.assert_allclose(on_grid, np.round(on_grid), atol=1e-6)
    summary = loop.deviation()
    assert summary.ticks == len(calls)
    assert summary.p50 <= summary.p99 <= summary.max
