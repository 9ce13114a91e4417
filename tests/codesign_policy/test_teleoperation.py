"""Joystick and keys to actions: known answers, limits, and silence unless somebody means it."""

import os
import pty
import termios

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codesign_policy.keyboard import Keyboard
from codesign_policy.task import MAX_ROTATION, MAX_TRANSLATION, MAX_WIDTH_CHANGE
from codesign_policy.teleoperation import KEYS, NONE, JoyMapping, Teleoperation

axes_lists = st.lists(st.floats(-1.0, 1.0), min_size=8, max_size=8)
button_lists = st.lists(st.integers(0, 1), min_size=8, max_size=8)


def held(*others: int) -> list[int]:
    """Buttons with the dead-man button and these pressed."""
    return [int(k in (JoyMapping().hold, *others)) for k in range(8)]


def sticks(**values: float) -> list[float]:
    """Axes at zero but for these, by number: a0=0.5."""
    return [values.get(f"a{k}", 0.0) for k in range(8)]


def test_a_full_stick_is_the_limit_of_one_action() -> None:
    teleoperation = Teleoperation()
    teleoperation.on_joy(sticks(a0=-1.0, a1=1.0, a3=1.0, a4=-1.0), held(), 0.0)
    action = teleoperation.action(0.05)
    assert action is not None
    np.testing.assert_allclose(action.translation, np.array([1.0, -1.0, -1.0]) * MAX_TRANSLATION)
    np.testing.assert_allclose(action.rotation, [0.0, 0.0, MAX_ROTATION])
    assert action.width == 0.0


def test_gap_buttons_move_the_gap_and_cancel_out() -> None:
    teleoperation = Teleoperation(JoyMapping(gap_speed=0.4))
    for buttons, expected in ((held(0), -0.4), (held(1), 0.4), (held(0, 1), 0.0)):
        teleoperation.on_joy(sticks(), buttons, 0.0)
        action = teleoperation.action(0.0)
        assert action is not None
        assert action.width == pytest.approx(expected * MAX_WIDTH_CHANGE)
        assert not action.translation.any()


def test_the_dead_zone_swallows_noise_and_leaves_no_step() -> None:
    mapping = JoyMapping(dead_zone=0.1)
    buttons = np.zeros(8, int)
    noise = mapping.normalised(np.full(8, 0.0999), buttons)
    assert not noise.any()
    just_beyond = mapping.normalised(np.full(8, 0.1 + 1e-6), buttons)
    assert 0.0 < just_beyond[0] < 2e-6
    assert mapping.normalised(np.full(8, 0.55), buttons)[0] == pytest.approx(0.5)


def test_gains_turn_and_scale_axes() -> None:
    mapping = JoyMapping(axes=(2, NONE, NONE, NONE, NONE, NONE, 5), gains=(-0.5, *[1.0] * 6))
    asked = mapping.normalised(np.array(sticks(a2=1.0, a5=-1.0)), np.zeros(8, int))
    assert asked.tolist() == [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]


@given(axes_lists, button_lists, st.sets(st.sampled_from(sorted(KEYS))))
def test_no_action_exceeds_the_limits(
    axes: list[float], buttons: list[int], keys: set[str]
) -> None:
    teleoperation = Teleoperation()
    teleoperation.on_joy(axes, buttons, 1.0)
    for key in keys:
        teleoperation.on_key(key, 1.0)
    action = teleoperation.action(1.0)
    if buttons[7] or not (buttons[4] or keys):
        assert action is None
    else:
        assert action is not None
        assert np.abs(action.normalised()).max() <= 1.0


@given(axes_lists, button_lists)
def test_without_the_dead_man_button_nothing_is_sent(axes: list[float], buttons: list[int]) -> None:
    teleoperation = Teleoperation()
    buttons[4] = buttons[7] = 0
    teleoperation.on_joy(axes, buttons, 0.0)
    assert teleoperation.action(0.0) is None
    assert teleoperation.silence(0.0) == "dead-man button 4 is not pressed"


def test_a_stale_joystick_stops() -> None:
    teleoperation = Teleoperation(timeout=0.2)
    assert teleoperation.action(0.0) is None
    teleoperation.on_joy(sticks(a0=1.0), held(), 5.0)
    assert teleoperation.action(5.19) is not None
    assert teleoperation.action(5.21) is None
    assert "no joystick message within 0.2 s" in teleoperation.silence(5.21)


@pytest.mark.parametrize(
    ("axes", "buttons", "why"),
    [
        (sticks(a6=float("nan")), held(), "axis 6 is nan"),
        (sticks(a1=float("inf")), held(), "axis 1 is inf"),
        (sticks(a1=1.5), held(), "axis 1 is 1.5"),
        ([0.0] * 4, held(), "4 axes and 8 buttons: the mapping needs 5 and 8"),
        (sticks(), [0, 0, 0, 0, 1], "8 axes and 5 buttons"),
        ([], [], "0 axes and 0 buttons"),
    ],
)
def test_bad_messages_are_refused_and_stop(axes: list[float], buttons: list[int], why: str) -> None:
    teleoperation = Teleoperation()
    teleoperation.on_joy(sticks(a0=1.0), held(), 0.0)
    assert teleoperation.action(0.0) is not None
    with pytest.raises(ValueError, match=why):
        teleoperation.on_joy(axes, buttons, 0.01)
    assert teleoperation.rejected == 1
    assert teleoperation.action(0.01) is None


def test_keys_move_while_they_are_heard() -> None:
    teleoperation = Teleoperation(JoyMapping(key_speed=0.5, gap_speed=0.2))
    for key in "wfcx":
        teleoperation.on_key(key, 0.0)
    action = teleoperation.action(0.2)
    assert action is not None
    assert action.normalised().tolist() == pytest.approx([0.5, 0.0, -0.5, 0.0, 0.0, 0.0, -0.2])
    assert teleoperation.action(0.21) is None


def test_the_space_bar_holds_still() -> None:
    teleoperation = Teleoperation()
    teleoperation.on_key(" ", 0.0)
    action = teleoperation.action(0.1)
    assert action is not None
    assert not action.normalised().any()


@pytest.mark.parametrize("finish", ["key", "button"])
def test_finishing_ends_the_actions_until_the_next_start(finish: str) -> None:
    teleoperation = Teleoperation()
    teleoperation.on_joy(sticks(), held(7) if finish == "button" else held(), 0.0)
    if finish == "key":
        teleoperation.on_key("\n", 0.0)
    teleoperation.on_joy(sticks(), held(), 0.01)
    assert teleoperation.finished
    assert teleoperation.action(0.01) is None
    teleoperation.reset()
    teleoperation.on_joy(sticks(), held(), 0.02)
    assert teleoperation.action(0.02) is not None


@pytest.mark.parametrize(
    "change",
    [
        {"axes": (0, 1)},
        {"axes": (-2, 0, 4, NONE, NONE, 3, NONE)},
        {"hold": NONE},
        {"dead_zone": 1.0},
        {"gains": (2.0, *[1.0] * 6)},
        {"gains": (*[1.0] * 6, float("nan"))},
        {"gap_speed": 0.0},
        {"key_speed": float("nan")},
    ],
)
def test_bad_mappings_are_refused(change: dict) -> None:
    with pytest.raises(ValueError, match=r"must be|give 7|name one"):
        JoyMapping(**change)


def test_a_terminal_gets_its_mode_back() -> None:
    ours, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)
    keyboard = Keyboard(terminal)
    assert not termios.tcgetattr(terminal)[3] & (termios.ICANON | termios.ECHO)
    assert keyboard.read() == ""
    os.write(ours, b"wwc")
    assert keyboard.read() == "wwc"
    keyboard.close()
    assert termios.tcgetattr(terminal) == before
    keyboard.close()
    os.close(ours)
    os.close(terminal)


def test_a_pipe_is_no_keyboard() -> None:
    reading, writing = os.pipe()
    with pytest.raises(ValueError, match="not a terminal"):
        Keyboard(reading)
    os.close(reading)
    os.close(writing)
