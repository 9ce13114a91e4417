"""Faults of arm, network, sender and driver, with the real SDK against the fake control box.

`Rig` asserts after each test, from the box's log, that no bad command was on the wire: nothing that
is not finite, outside the joint limits or a jump, and no start anywhere but where the arm was.
"""

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from codesign_control.driver import CommandRefused, DriverState, LinkError
from tests.fake_box import wait_for
from tests.fake_box.rig import PERIOD, Rig, turned, wave

TICK = 0.01  # s, of the driver at its default rate


@pytest.fixture
def rig() -> Iterator[Rig]:
    with Rig() as rig:
        yield rig


@pytest.fixture
def moving(rig: Rig) -> Rig:
    rig.stream()
    rig.commander.follow(wave())
    time.sleep(0.5)
    return rig


def assert_still(rig: Rig, seconds: float = 0.3) -> None:
    """Commands come, but nothing goes out."""
    since, sent = time.monotonic(), rig.commander.sent
    time.sleep(seconds)
    assert rig.commander.sent > sent + 10
    assert not rig.box.commands("servo_j", since=since)


def stop_and_match(rig: Rig) -> None:
    """What an operator does once the driver is enabled again: the controller starts anew."""
    rig.match()
    rig.commander.follow(wave())
    time.sleep(0.5)
    assert rig.driver.state is DriverState.STREAMING
    assert np.abs(rig.driver.measured.velocity).max() > 0.02


# --- errors of the arm


@pytest.mark.parametrize("error", [22, 23, 31, 60])
def test_an_error_of_the_arm_is_latched_and_recovered_by_the_service(
    moving: Rig, error: int
) -> None:
    failed = time.monotonic()
    moving.box.switch(error=error)
    moving.wait_for(DriverState.FAULT, 1.0)
    wait_for(lambda: f"C{error} " in moving.driver.status().message, 1.0, "its code is told")
    late = [r["t"] - failed for r in moving.box.commands("servo_j", since=failed + 0.05)]
    assert not late  # a tick or two until the reply with the error was judged
    assert_still(moving)
    with pytest.raises(LinkError, match=f"C{error} .*call recover"):
        moving.driver.enable()
    assert moving.driver.state is DriverState.FAULT

    assert "commands match" in moving.driver.recover()
    # The commands went on meanwhile, and are elsewhere: still nothing moves.
    moving.commander.hold(turned(moving.driver.measured.position, 0.2))
    assert_still(moving)
    stop_and_match(moving)


@pytest.mark.parametrize("error", [1, 2, 3])
def test_an_emergency_stop_stays_until_the_button_is_released(moving: Rig, error: int) -> None:
    moving.box.switch(emergency_stop=error)
    moving.wait_for(DriverState.FAULT, 1.0)
    with pytest.raises(LinkError, match=f"C{error} .* is still there"):
        moving.driver.recover()
    assert moving.driver.state is DriverState.FAULT
    assert_still(moving)
    moving.box.switch(emergency_stop=0)
    assert_still(moving)  # releasing the button alone moves nothing
    moving.driver.recover()
    stop_and_match(moving)


def test_an_arm_moved_by_hand_during_a_stop_does_not_spring_back(moving: Rig) -> None:
    moving.commander.hold(moving.driver.measured.position)
    moving.box.switch(emergency_stop=1)
    moving.wait_for(DriverState.FAULT, 1.0)
    moved = turned(moving.driver.measured.position, 0.3, joint=2)
    moving.box.switch(joints=moved.tolist())
    moving.box.switch(emergency_stop=0)
    moving.driver.recover()
    assert_still(moving)  # the old posture is still commanded
    assert "joint 2 is commanded" in moving.driver.status().last_refusal
    np.testing.assert_allclose(moving.joints(), moved, atol=1e-6)
    stop_and_match(moving)


@pytest.mark.parametrize("change", [{"mode": 0}, {"state": 3}, {"state": 4}])
def test_somebody_else_who_changes_mode_or_state_ends_streaming(
    moving: Rig, change: dict[str, int]
) -> None:
    moving.box.switch(**change)
    moving.wait_for(DriverState.FAULT, 1.0)
    assert_still(moving)
    moving.driver.recover()
    stop_and_match(moving)


# --- control box and network


def test_a_hung_controller_costs_no_tick(moving: Rig) -> None:
    missed, ticks = moving.driver.status().ticks_missed, len(moving.driver.deviations())
    hung = time.monotonic()
    moving.box.switch(hung=True)
    wait_for(lambda: moving.driver.state is not DriverState.STREAMING, 1.0, "it is noticed")
    assert time.monotonic() - hung < 0.3
    time.sleep(max(0.0, 1.0 - (time.monotonic() - hung)))
    status = moving.driver.status()
    assert status.ticks_missed - missed <= 1
    assert len(moving.driver.deviations()) - ticks > 0.9 / TICK  # the loop goes on
    assert "hangs" in status.message or "silent" in status.message
    back = time.monotonic()
    moving.box.switch(hung=False)
    moving.wait_for(DriverState.DISABLED, 2.0)
    assert time.monotonic() - back < 2.0
    # What was on the wire when it hung: at most what `reply_patience` and a tick allow.
    assert len(moving.box.commands("servo_j", since=back - 0.01)) <= 8
    assert_still(moving)
    moving.driver.enable()
    stop_and_match(moving)


def test_a_short_hang_is_a_fault_too(moving: Rig) -> None:
    moving.box.switch(hung=True)
    time.sleep(0.15)
    moving.box.switch(hung=False)
    moving.wait_for(DriverState.FAULT, 1.0)
    time.sleep(0.1)  # what was on its way when the box hung, it takes now
    assert_still(moving)
    moving.driver.recover()
    stop_and_match(moving)


def test_replies_a_little_late_change_nothing(moving: Rig) -> None:
    missed = moving.driver.status().ticks_missed
    moving.box.switch(delay=0.003)
    time.sleep(1.0)
    status = moving.driver.status()
    assert status.state is DriverState.STREAMING
    assert status.ticks_missed == missed


def test_replies_too_late_are_a_fault_and_cost_no_tick(moving: Rig) -> None:
    missed = moving.driver.status().ticks_missed
    moving.box.switch(delay=0.05)
    moving.wait_for(DriverState.FAULT, 2.0)
    assert moving.driver.status().ticks_missed - missed <= 1
    assert moving.driver.status().replies_late > 3
    moving.box.switch(delay=0.0)
    time.sleep(3.0)  # its backlog
    moving.driver.recover()
    stop_and_match(moving)


@pytest.mark.parametrize("fault", ["drop", "offline", "silent"])
def test_a_lost_connection_comes_back_within_two_seconds_and_wants_enabling(
    moving: Rig, fault: str
) -> None:
    connections = moving.driver.status().connections
    moving.box.switch(**{fault: True})
    if fault != "drop":
        moving.wait_for(DriverState.DISCONNECTED, 2.0)
        time.sleep(0.5)
        moving.box.switch(**{fault: False})
    back = time.monotonic()
    wait_for(
        lambda: moving.driver.status().connections > connections and moving.driver.measured,
        2.0,
        "a new connection and its first report",
    )
    moving.wait_for(DriverState.DISABLED, 0.5)
    assert time.monotonic() - back < 2.0
    assert_still(moving)
    moving.driver.enable()
    stop_and_match(moving)
    wait_for(lambda: not moving.driver.status().gripper_message, 3.0, "the gripper answers again")


def test_a_driver_that_starts_anew_matches_the_posture_and_wants_enabling(moving: Rig) -> None:
    began = time.monotonic()
    moving.restart_driver()
    assert time.monotonic() - began < 2.0
    np.testing.assert_allclose(moving.driver.measured.position, moving.joints(), atol=1e-3)
    assert_still(moving)
    moving.driver.enable()
    stop_and_match(moving)


# --- who commands


RUBBISH: list[Any] = [
    [],
    [0.0] * 6,
    [0.0] * 8,
    [math.nan] * 7,
    [math.inf] + [0.0] * 6,
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -math.inf],
    [100.0] * 7,
    [0.0] * 7,  # finite and legal, but 1.2 rad away
]


def test_rubbish_between_good_commands_is_counted_and_disturbs_nothing(moving: Rig) -> None:
    began = time.monotonic()
    for k in range(200):
        with pytest.raises(CommandRefused):
            moving.driver.command(RUBBISH[k % len(RUBBISH)], time.monotonic())
        time.sleep(0.005)
    status = moving.driver.status()
    assert status.state is DriverState.STREAMING
    assert status.pauses == 0
    refused = status.refused
    assert refused["wrong_length"] == refused["not_finite"] == 75
    assert refused["outside_limits"] == refused["too_fast"] == 25
    moments, points = moving.box.servo_points(since=began)
    assert len(moments) > 0.9 * 200 * 0.005 / TICK
    assert np.abs(np.diff(points, axis=0)).max() < 0.3 * 1.2 * TICK * 1.5


def test_stale_commands_are_refused_and_then_the_arm_stops(moving: Rig) -> None:
    moving.commander.paused = True
    posture = moving.driver.measured.position
    end = time.monotonic() + 0.5
    while time.monotonic() < end:
        with pytest.raises(CommandRefused) as refusal:
            moving.driver.command(posture, time.monotonic() - 0.2)
        assert refusal.value.reason == "stale"
        time.sleep(PERIOD)
    assert moving.driver.state is DriverState.MATCHING
    assert "no command for" in moving.driver.status().message
    since = time.monotonic()
    time.sleep(0.2)
    assert not moving.box.commands("servo_j", since=since)
    stop_and_match(moving)


def test_a_sender_that_pauses_and_jumps_does_not_move_the_arm(moving: Rig) -> None:
    moving.commander.paused = True
    moving.wait_for(DriverState.MATCHING, 1.0)
    where = moving.joints()
    moving.commander.hold(turned(where, -0.1, joint=4))
    assert_still(moving)
    np.testing.assert_allclose(moving.joints(), where, atol=1e-3)
    stop_and_match(moving)


def test_a_start_outside_the_limits_is_refused(rig: Rig) -> None:
    rig.box.switch(joints=[0.0, 2.06, 0.0, 1.0, 0.0, 1.0, 0.0])
    rig.driver.enable()
    rig.commander.hold([0.0, 2.06, 0.0, 1.0, 0.0, 1.0, 0.0])
    assert_still(rig)
    assert rig.driver.status().refused["outside_limits"] > 10
    assert "joint 2: 2.0600 rad, limits -2.0420..2.0246 rad" in rig.driver.status().last_refusal


def test_hostile_commands_for_seconds_leave_no_mark_on_the_wire(rig: Rig) -> None:
    """Sawtooth at the velocity limit, jumps, rubbish, wrong clocks, all mixed; `Rig` judges."""
    rig.stream()
    random = np.random.default_rng(5)
    end = time.monotonic() + 4.0
    sent = 0
    while time.monotonic() < end:
        if rig.driver.state is not DriverState.STREAMING:
            rig.match()
        rig.commander.posture = rig.commander.posture + random.choice([-1, 1], 7) * 0.012
        for _ in range(random.integers(4)):
            position = rig.commander.posture + random.normal(size=7) * 10.0 ** random.integers(
                -3, 4
            )
            try:
                rig.driver.command(position, time.monotonic() + random.uniform(-0.3, 0.3))
            except CommandRefused:
                sent += 1
        time.sleep(0.01)
    assert sent > 100
    assert len(rig.box.servo_points()[0]) > 100
    assert rig.driver.status().pauses > 1
