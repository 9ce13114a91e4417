"""Set-points read later, with jitter, gaps and clocks that jump."""

import numpy as np
import pytest

from codesign_control.setpoint_buffer import KEPT, SetpointBuffer


def line(t: float) -> np.ndarray:
    return np.arange(1.0, 8.0) * t


def filled(moments: np.ndarray) -> SetpointBuffer:
    buffer = SetpointBuffer()
    for t in moments:
        buffer.add(float(t), line(float(t)))
    return buffer


def test_empty_buffer_has_no_setpoint() -> None:
    assert SetpointBuffer().at(0.0) is None


def test_linear_between_and_constant_outside() -> None:
    buffer = filled(np.array([0.0, 0.01, 0.03]))
    for t in (0.0, 0.004, 0.01, 0.017, 0.03):
        np.testing.assert_allclose(buffer.at(t), line(t), atol=1e-15)
    np.testing.assert_allclose(buffer.at(-0.1), line(0.0))
    np.testing.assert_allclose(buffer.at(0.2), line(0.03))


def test_lost_setpoints_leave_no_jump() -> None:
    moments = np.delete(np.arange(0.0, 0.5, 0.01), [10, 11, 12, 30])
    buffer = filled(moments)
    path = np.array([buffer.at(t) for t in np.arange(0.0, 0.49, 0.001)])
    assert np.abs(np.diff(path, axis=0)).max() == pytest.approx(0.001 * 7, rel=1e-6)


def test_clock_put_back_or_far_apart_gives_the_newest() -> None:
    buffer = filled(np.arange(100.0, 100.2, 0.01))
    buffer.add(50.0, line(3.0))
    np.testing.assert_array_equal(buffer.at(150.0), line(3.0))
    np.testing.assert_array_equal(buffer.at(50.0), line(3.0))


def test_keeps_a_bounded_number() -> None:
    buffer = filled(np.arange(0.0, 10.0, 0.01))
    np.testing.assert_allclose(buffer.at(9.6), line(9.6), atol=1e-9)
    assert len(buffer) == KEPT


@pytest.mark.parametrize("bad", [np.full(7, np.nan), np.zeros(6), [np.inf] * 7])
def test_refuses_what_is_not_seven_finite_angles(bad: object) -> None:
    with pytest.raises(ValueError, match="joint command"):
        SetpointBuffer().add(0.0, bad)
