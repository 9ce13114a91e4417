"""The stand-in arm: known step responses, limits, determinism."""

import math

import numpy as np
import pytest

from codesign_control import ArmModel, ArmModelConfig, Xarm7


@pytest.mark.parametrize("dt", [0.001, 0.004, 0.01])
def test_first_order_reaches_63_percent_after_one_time_constant(arm: Xarm7, dt: float) -> None:
    model = ArmModel(arm, ArmModelConfig(order=1, time_constant=0.02))
    command = arm.home + 0.01
    for _ in range(round(0.02 / dt)):
        position, _ = model.step(command, dt)
    np.testing.assert_allclose(position - arm.home, 0.01 * (1 - math.exp(-1)), rtol=1e-9)


@pytest.mark.parametrize("dt", [0.001, 0.004, 0.01])
def test_second_order_is_two_lags_in_series(arm: Xarm7, dt: float) -> None:
    model = ArmModel(arm, ArmModelConfig(order=2, time_constant=0.02))
    command = arm.home + 0.01
    for _ in range(round(0.06 / dt)):
        position, _ = model.step(command, dt)
    np.testing.assert_allclose(position - arm.home, 0.01 * (1 - 4 * math.exp(-3)), rtol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
def test_follows_no_faster_than_its_limit_and_arrives(arm: Xarm7, order: int) -> None:
    model = ArmModel(arm, ArmModelConfig(order=order, velocity_limit=0.5))
    command = arm.home + np.linspace(-0.5, 0.5, 7)
    speeds = []
    for _ in range(400):
        position, velocity = model.step(command, 0.01)
        speeds.append(np.abs(velocity).max())
    assert max(speeds) == pytest.approx(0.5)
    np.testing.assert_allclose(position, command, atol=1e-9)
    np.testing.assert_allclose(velocity, 0.0, atol=1e-9)


def test_velocity_is_the_change_of_position(arm: Xarm7) -> None:
    model = ArmModel(arm)
    before, _ = model.step(arm.home + 0.02, 0.01)
    after, velocity = model.step(arm.home + 0.02, 0.01)
    np.testing.assert_allclose(velocity, (after - before) / 0.01)


def test_stops_at_the_joint_limits(arm: Xarm7) -> None:
    model = ArmModel(arm)
    for _ in range(500):
        position, _ = model.step(arm.upper + 1.0, 0.01)
    np.testing.assert_array_equal(position, arm.upper)


def test_same_commands_same_motion(arm: Xarm7) -> None:
    def motion() -> list[np.ndarray]:
        model = ArmModel(arm, ArmModelConfig(order=2))
        return [model.step(arm.home + 0.1 * math.sin(i), 0.01)[0] for i in range(50)]

    np.testing.assert_array_equal(motion(), motion())


@pytest.mark.parametrize("command", [[math.nan] * 7, [math.inf] * 7, [0.0] * 6])
def test_refuses_bad_commands_and_stays(arm: Xarm7, command: list[float]) -> None:
    model = ArmModel(arm)
    with pytest.raises(ValueError, match="command"):
        model.step(command, 0.01)
    np.testing.assert_array_equal(model.position, arm.home)


@pytest.mark.parametrize(
    "values", [{"order": 3}, {"time_constant": 0.0}, {"velocity_limit": math.nan}]
)
def test_refuses_bad_settings(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        ArmModelConfig(**values)
