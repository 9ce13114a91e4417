"""The driver with the real SDK against a fake control box: start, streaming, pauses, gripper."""

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from codesign_control.driver import CommandRefused, DriverConfig, DriverState, LinkError, XarmDriver
from codesign_control.driver.gripper import GripperReading, GripperThread
from codesign_control.gripper import STOCK_PROTRUSION, GripperModel
from tests.fake_box import wait_for
from tests.fake_box.rig import Rig, turned, wave

NARROW = GripperModel(STOCK_PROTRUSION + 0.014)


@pytest.fixture
def rig() -> Iterator[Rig]:
    with Rig() as rig:
        yield rig


def test_reports_where_the_arm_is_and_touches_nothing(rig: Rig) -> None:
    rig.box.switch(joints=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    wait_for(lambda: len(rig.reports) > 100, 5.0, "reports")
    np.testing.assert_allclose(rig.reports[-1].position, np.arange(1, 8) / 10, atol=1e-6)
    moments = [m.moment for m in rig.reports[20:]]
    assert np.median(np.diff(moments)) == pytest.approx(0.01, rel=0.05)
    rig.commander.hold(rig.reports[-1].position)
    time.sleep(0.2)
    assert rig.driver.state is DriverState.DISABLED
    assert not rig.box.commands("servo_j", "motion_enable", "set_mode", "set_state", "write_tool")


@pytest.mark.parametrize("rate", [100, 250])
def test_follows_commands_from_the_measured_posture_on(rate: int) -> None:
    with Rig(rate=rate, realtime=rate == 250) as rig:
        rig.stream()
        start = rig.driver.measured.position
        rig.commander.follow(wave(amplitude=0.5))
        time.sleep(2.0)
        moments, points = rig.box.servo_points()
        np.testing.assert_allclose(points[0], start, atol=1e-4)
        assert np.median(np.diff(moments)) == pytest.approx(1.0 / rate, rel=0.1)
        # The wave's own velocity and acceleration, 0.5 rad/s and 1 rad/s^2 at most; catching up
        # may add a fifth.
        assert np.abs(np.diff(points, axis=0)).max() * rate < 0.5 * 1.2 + 0.05
        assert np.ptp(points[:, 0]) == pytest.approx(0.5, abs=0.02)
        assert rig.driver.status().pauses == 0


def test_velocity_is_the_arms(rig: Rig) -> None:
    rig.stream()
    rig.commander.follow(lambda t: np.array([0.3, 0, 0, 0, 0, 0, 0]) * min(t, 1.5))
    time.sleep(1.0)
    assert np.median([m.velocity[0] for m in rig.reports[-40:]]) == pytest.approx(0.3, abs=0.03)


def test_commands_away_from_the_arm_move_nothing(rig: Rig) -> None:
    rig.driver.enable()
    away = turned(rig.driver.measured.position, 0.011)
    rig.commander.hold(away)
    wait_for(lambda: rig.driver.status().refused.get("no_match", 0) > 20, 5.0, "refusals")
    assert rig.driver.state is DriverState.MATCHING
    assert "joint 1 is commanded 0.0110 rad away" in rig.driver.status().last_refusal
    assert not rig.box.commands("servo_j")


def test_a_small_difference_at_the_start_is_blended_out(rig: Rig) -> None:
    rig.driver.enable()
    start = rig.driver.measured.position
    rig.commander.hold(turned(start, 0.009))
    rig.wait_for(DriverState.STREAMING)
    time.sleep(1.0)
    _, points = rig.box.servo_points()
    np.testing.assert_allclose(points[0], start, atol=1e-4)
    assert np.abs(np.diff(points, axis=0)).max() < 4e-4  # 0.03 rad/s
    assert points[-1, 0] - start[0] == pytest.approx(0.009, abs=1e-5)


def test_moving_commands_do_not_start_it(rig: Rig) -> None:
    rig.driver.enable()
    rig.commander.posture = rig.driver.measured.position - [0.3, 0, 0, 0, 0, 0, 0]
    rig.commander.follow(lambda t: np.array([0.4 * t, 0, 0, 0, 0, 0, 0]))
    rig.commander.paused = False
    time.sleep(1.2)  # the commands pass the posture at 0.4 rad/s
    assert not rig.box.commands("servo_j")
    assert rig.driver.status().refused["no_match"] > 20


def test_lost_commands_stop_the_arm_on_its_path(rig: Rig) -> None:
    rig.stream()
    rig.commander.follow(lambda t: np.array([0.5 * t, 0, 0, 0, 0, 0, 0]))
    time.sleep(0.6)
    rig.commander.paused = True
    rig.wait_for(DriverState.MATCHING)
    _, points = rig.box.servo_points()
    velocity = np.diff(points[:, 0]) / 0.01
    assert velocity.max() == pytest.approx(0.5, abs=0.11)
    assert velocity.min() > -1e-4  # never back
    # From 0.5 rad/s to rest in at least four periods, and no command was overshot.
    assert np.diff(velocity).min() > -0.2
    assert points[-1, 0] <= 0.5 * 0.61 + 0.005
    # Where the commands go on does not match: nothing moves.
    count = len(points)
    rig.commander.hold(turned(rig.driver.measured.position, 0.1))
    time.sleep(0.3)
    assert len(rig.box.servo_points()[0]) == count
    rig.match()
    assert rig.driver.status().pauses == 1


def test_disabling_stops_the_arm(rig: Rig) -> None:
    rig.stream()
    rig.driver.disable()
    assert rig.driver.state is DriverState.DISABLED
    assert rig.box.switch()["state"] == 4
    count = len(rig.box.commands("servo_j"))
    time.sleep(0.2)
    assert len(rig.box.commands("servo_j")) == count
    rig.stream()


def test_nobody_at_the_address_is_said_and_tried_again() -> None:
    with XarmDriver(DriverConfig(address="127.77.1.1")) as driver:
        wait_for(lambda: "no control box answers" in driver.status().message, 5.0, "message")
        with pytest.raises(LinkError, match=r"not connected: .*127\.77\.1\.1"):
            driver.enable()


def test_a_dry_run_reads_and_sends_nothing() -> None:
    with Rig(dry_run=True) as rig:
        for call in (rig.driver.enable, rig.driver.recover):
            with pytest.raises(LinkError, match="dry run"):
                call()
        rig.driver.disable()
        rig.commander.hold(rig.driver.measured.position)
        rig.driver.command_gripper(0.03)
        wait_for(lambda: len(rig.readings) > 10, 5.0, "the gripper's readings")
        rig.box.switch(error=31)
        wait_for(lambda: rig.driver.state is DriverState.FAULT, 5.0, "the error is seen")
        sent = {r["command"] for r in rig.box.commands()}
        assert sent <= {"get_version", "get_state", "get_error", "get_cmdnum", "gripper"}
        assert {r["gripper"] for r in rig.box.commands("gripper")} == {"read"}


# --- gripper


@pytest.mark.parametrize("kind", ["g1", "g2"])
@pytest.mark.parametrize("second_port", [True, False])
def test_the_gripper_goes_where_it_is_told(kind: str, second_port: bool) -> None:
    with Rig(gripper=kind, box={"second_port": second_port}) as rig:
        rig.stream()
        assert rig.driver.status().own_gripper_port is second_port
        for width in (0.03, 0.07, 0.01):
            rig.driver.command_gripper(width, speed=0.15)
            wait_for(
                lambda w=width: rig.readings and abs(rig.readings[-1].width - w) < 2e-4,
                5.0,
                f"gap {width}",
            )
        assert rig.readings[-1].target_width == 0.01
        assert rig.driver.state is DriverState.STREAMING
        writes = [r for r in rig.box.commands("gripper") if "target" in r]
        assert len(writes) == 3


def test_a_target_is_sent_once_and_what_is_held_stops_it(rig: Rig) -> None:
    rig.stream()
    rig.box.switch(gripper_obstacle=300.0)
    asked = time.monotonic()
    for _ in range(30):
        rig.driver.command_gripper(0.0, speed=0.2, effort=0.1)
        time.sleep(0.02)
    writes = [r for r in rig.box.commands("gripper") if "target" in r]
    assert len(writes) == 1
    assert writes[0]["force"] == 10
    assert writes[0]["t"] - asked > rig.config.delay  # not before the arm has made room for it
    wait_for(lambda: not rig.readings[-1].moving and rig.readings[-1].width < 0.05, 5.0, "grip")
    stopped = 110.0 * math.sin(math.radians(300.0 / 18.28 - 8.33)) + 16.0  # SDK's formula, mm
    assert rig.readings[-1].width == pytest.approx(stopped * 1e-3, abs=1e-4)


def test_gaps_are_those_of_the_mounted_fingers(rig: Rig) -> None:
    rig.driver.mount(GripperModel(protrusion=0.030))  # 4 mm deeper than the stock pads, each
    rig.stream()
    rig.driver.command_gripper(0.030)
    wait_for(lambda: abs(rig.readings[-1].width - 0.030) < 2e-4, 5.0, "the gap")
    pulses = rig.box.switch()["gripper_position"]
    stock = 110.0 * math.sin(math.radians(pulses / 18.28 - 8.33)) + 16.0
    assert stock == pytest.approx(38.0, abs=0.2)


@pytest.mark.parametrize("kind", ["g1", "g2"])
def test_fingers_that_are_mounted_amid_a_reading_do_not_end_it(kind: str) -> None:
    """A gap that only the fingers before could have: the readings go on."""
    readings: list[GripperReading] = []
    thread = GripperThread(DriverConfig(gripper=kind), readings.append)

    class Link:
        """Wide open; while that is on its way, narrower fingers are mounted."""

        def gripper_pulses(self) -> float:
            if not readings:
                thread.mount(NARROW)
            return 850.0

    thread.attach(Link())
    thread.start()
    try:
        deadline = time.monotonic() + 10.0
        while len(readings) < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
    finally:
        thread.stop()
    assert len(readings) >= 3
    assert readings[0].width > 0.08
    assert [r.width for r in readings[1:3]] == pytest.approx([readings[0].width - 0.028] * 2)
    assert [r.velocity for r in readings[1:3]] == [0.0, 0.0]  # other fingers are no motion


def test_the_gripper_does_not_move_before_enabling_nor_after_an_old_command(rig: Rig) -> None:
    rig.driver.command_gripper(0.02)
    rig.stream()
    time.sleep(0.3)
    assert not [r for r in rig.box.commands("gripper") if "target" in r]


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        ((math.nan, 0.1, 0.5), "not_finite"),
        ((0.03, math.inf, 0.5), "not_finite"),
        ((0.5, 0.1, 0.5), "outside_limits"),
        ((0.03, -0.1, 0.5), "outside_limits"),
        ((0.03, 0.1, 1.5), "outside_limits"),
    ],
)
def test_nonsense_for_the_gripper_is_refused(command: tuple[float, ...], reason: str) -> None:
    driver: Any = XarmDriver(DriverConfig())  # never started
    with pytest.raises(CommandRefused) as refusal:
        driver.command_gripper(*command)
    assert refusal.value.reason == reason
    assert driver.status().refused == {reason: 1}


def test_an_error_of_the_gripper_is_reported_and_recovered(rig: Rig) -> None:
    rig.stream()
    rig.box.switch(gripper_error=11)
    wait_for(lambda: "G11" in rig.driver.status().gripper_message, 5.0, "the error is reported")
    assert rig.driver.state is DriverState.STREAMING
    rig.driver.recover()
    wait_for(lambda: not rig.driver.status().gripper_message, 5.0, "the error is gone")
    rig.match()
