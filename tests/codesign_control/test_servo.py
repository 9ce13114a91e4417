"""The servo's states, watchdogs and requests."""

import math

import numpy as np
import pytest
from servo_run import STILL, Run

from codesign_control import (
    ActionRejected,
    ArmModel,
    ArmModelConfig,
    CartesianServo,
    GoalState,
    MoveRejected,
    Pose,
    ServoConfig,
    ServoState,
    Xarm7,
)
from codesign_control.motion import TrajectoryError

SIDE = np.array([0.0, 0.005, 0.0])  # 0.1 m/s at the default action period


def speed(run: Run) -> float:
    return float(np.abs(run.outputs[-1].velocity).max())


# Following actions -------------------------------------------------------------------------------


def test_first_set_point_is_the_measured_posture(arm: Xarm7) -> None:
    start = arm.home + 0.01
    run = Run(arm, start=start)
    output = run.step()
    np.testing.assert_array_equal(output.position, start)
    np.testing.assert_array_equal(output.velocity, np.zeros(7))
    assert output.state is ServoState.READY
    assert output.active


def test_actions_add_up_on_the_reference_whatever_is_measured(arm: Xarm7) -> None:
    run = Run(arm)
    lagging = ArmModel(arm, ArmModelConfig(time_constant=0.05))
    began = run.servo.commanded_pose.position
    turn = np.array([0.0, 0.0, 0.01])
    for _ in range(20):
        run.servo.submit(SIDE, turn, run.now)
        for _ in range(5):
            output = run.servo.step(lagging.position, run.now)
            lagging.step(output.position, 0.01)
            run.now += 0.01
    for _ in range(30):  # zeros hold, and let the motion finish
        run.servo.submit(STILL, STILL, run.now)
        for _ in range(5):
            output = run.servo.step(lagging.position, run.now)
            lagging.step(output.position, 0.01)
            run.now += 0.01
    pose = run.servo.commanded_pose
    np.testing.assert_allclose(pose.position - began, 20 * SIDE, atol=1e-7)
    down_and_turned = np.diag([1.0, -1.0, -1.0])
    c, s = math.cos(0.2), math.sin(0.2)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ down_and_turned
    np.testing.assert_allclose(pose.rotation, turned, atol=1e-6)
    np.testing.assert_allclose(run.servo.reference_pose.position - began, 20 * SIDE, atol=1e-12)


def test_motion_starts_in_the_tick_after_the_action(arm: Xarm7) -> None:
    run = Run(arm)
    run.step(10)
    run.servo.submit(SIDE, STILL, run.now)
    assert np.abs(run.step().position - arm.home).max() > 1e-6


def test_a_steady_stream_moves_at_steady_speed(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(30):
        run.act(SIDE)
    speeds = np.linalg.norm(np.diff(run.tcp()[-60:], axis=0), axis=1) / 0.01
    np.testing.assert_allclose(speeds, 0.1, rtol=0.01)  # velocity fed forward: no stop and go


def test_approach_to_a_stop_overshoots_by_less_than_half_a_millimetre(arm: Xarm7) -> None:
    run = Run(arm)
    began = run.tcp()[-1, 1]
    for _ in range(20):
        run.act(SIDE)
    for _ in range(20):
        run.act(STILL)
    assert (run.tcp()[:, 1] - began).max() < 0.1 + 0.0005


def test_holds_without_drift_for_a_minute(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(10):
        run.act(np.array([0.003, 0.004, -0.002]), np.array([0.01, 0.0, 0.02]))
    for _ in range(40):
        run.act(STILL)
    settled = run.tcp()[-1]
    for _ in range(1200):
        run.act(STILL)
    assert np.abs(run.tcp()[-1] - settled).max() < 1e-6
    assert run.servo.counters.brakes == 0


def test_reference_does_not_run_away_from_an_arm_at_the_box(arm: Xarm7) -> None:
    run = Run(arm, ServoConfig(table_height=-0.1))
    for _ in range(60):
        run.act(np.array([0.0, 0.0, -0.0125]))
    floor = run.servo.config.box_lower[2]
    assert run.servo.commanded_pose.position[2] == pytest.approx(floor + 0.002, abs=1e-4)
    run.act(np.array([0.0, 0.0, 0.0125]))
    run.act(STILL)
    run.act(STILL)
    assert run.servo.commanded_pose.position[2] > floor + 0.005  # turns round with the action


# Rejected actions --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("translation", "rotation", "message"),
    [
        ([math.nan, 0, 0], [0, 0, 0], "translation: not finite"),
        ([0, 0, 0], [0, math.inf, 0], "rotation: not finite"),
        ([0, 0], [0, 0, 0], "translation: shape"),
        ([], [], "translation: shape"),
        ([0, 0, 0], [0, 0, 0, 0], "rotation: shape"),
        (["a", 0, 0], [0, 0, 0], "translation: not a list of numbers"),
        ([0.02, 0, 0], [0, 0, 0], "translation: 0.02 m, limit of one action 0.0125 m"),
        ([1e300, 0, 0], [0, 0, 0], "translation: .* limit"),
        ([0, 0, 0], [0, 0, -0.2], "rotation: 0.2 rad, limit of one action 0.05 rad"),
    ],
)
def test_bad_actions_are_counted_and_change_nothing(
    arm: Xarm7, translation: list, rotation: list, message: str
) -> None:
    run = Run(arm)
    with pytest.raises(ActionRejected, match=message):
        run.servo.submit(translation, rotation, run.now)
    output = run.step(20)
    assert output.counters.actions_rejected == 1
    assert output.counters.actions_accepted == 0
    assert output.state is ServoState.READY
    np.testing.assert_array_equal(output.position, arm.home)


def test_a_stream_of_only_bad_actions_goes_stale(arm: Xarm7) -> None:
    run = Run(arm)
    run.act(SIDE)
    for _ in range(6):
        with pytest.raises(ActionRejected):
            run.servo.submit([math.nan] * 3, STILL, run.now)
        output = run.step(5)
    assert output.state is ServoState.HALTED


def test_actions_need_an_enabled_servo(arm: Xarm7) -> None:
    servo = CartesianServo(arm)
    with pytest.raises(ActionRejected, match="DISABLED"):
        servo.submit(SIDE, STILL, 0.0)
    assert servo.counters.actions_rejected == 1


# Watchdogs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("action_period", [0.05, 0.1])
@pytest.mark.parametrize(
    ("translation", "rotation"),
    [([0, 0.25, 0], [0, 0, 0]), ([0.1, 0.1, -0.2], [0, 0, 0]), ([0, 0.2, 0.1], [0.6, 0.3, 0.6])],
)
def test_stands_within_300_ms_of_the_last_action(
    arm: Xarm7, action_period: float, translation: list, rotation: list
) -> None:
    config = ServoConfig(
        action_period=action_period,
        action_translation=0.25 * action_period,
        action_rotation=1.0 * action_period,
    )
    run = Run(arm, config)
    step, turn = np.array(translation) * action_period, np.array(rotation) * action_period
    for _ in range(round(0.6 / action_period)):
        run.act(step, turn)
    assert np.linalg.norm(np.diff(run.tcp()[-2:], axis=0)) / 0.01 > 0.2
    already = round(action_period / 0.01)  # ticks since the last action
    output = run.step(30 - already)
    assert output.state is ServoState.HALTED
    assert speed(run) == 0.0
    assert output.counters.halts == 1
    run.assert_within_limits()


def test_halt_comes_in_the_tick_after_150_ms(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(10):
        run.act(SIDE)
    last_action = run.now - 0.05
    while run.step().state is ServoState.MOVING:
        pass
    halted_at = run.now - 0.01
    assert 0.15 < halted_at - last_action <= 0.16 + 1e-9


def test_resumes_without_a_jump(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(10):
        run.act(2.5 * SIDE)
    while run.step().state is not ServoState.HALTED:
        pass
    assert speed(run) > 0.005  # fresh again while it still brakes
    run.act(SIDE)
    run.step(100)
    before = run.servo.commanded_pose.position
    for _ in range(4):
        run.act(SIDE)
    for _ in range(20):
        run.act(STILL)
    assert run.outputs[-1].state is ServoState.MOVING
    moved = run.servo.commanded_pose.position - before
    np.testing.assert_allclose(moved, 4 * SIDE, atol=1e-6)  # from where it stood, nothing caught up
    run.assert_within_limits()


@pytest.mark.parametrize("jump", [50.0, -50.0, math.nan])
def test_a_jump_of_the_clock_halts_smoothly_and_goes_on(arm: Xarm7, jump: float) -> None:
    run = Run(arm, ServoConfig(measurement_timeout=1e6))
    for _ in range(10):
        run.act(SIDE)
    steady = run.now
    run.now += jump
    run.step(3)
    assert run.outputs[-1].state in (ServoState.HALTED, ServoState.FAULT)
    run.step(30)
    assert speed(run) == 0.0
    run.assert_within_limits()
    if run.outputs[-1].state is ServoState.FAULT:  # no measurement can be in the future
        run.servo.reset_fault(run.position, steady)
        run.servo.enable(run.position, steady)
    run.now = steady
    run.act(SIDE)
    assert run.outputs[-1].state is ServoState.MOVING


def test_fault_without_measurements(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(10):
        run.act(SIDE)
    outputs = []
    for i in range(40):
        if i % 5 == 0 and run.servo.state is not ServoState.FAULT:
            run.servo.submit(SIDE, STILL, run.now)
        outputs.append(run.servo.step(None, run.now))
        run.now += 0.01
    run.outputs += outputs
    assert outputs[18].state is ServoState.MOVING
    assert outputs[-1].state is ServoState.FAULT
    assert "no measured posture" in outputs[-1].message
    assert not outputs[-1].active
    assert np.abs(outputs[-1].velocity).max() == 0.0


@pytest.mark.parametrize("measured", [[math.nan] * 7, [0.0] * 6, [], [math.inf] * 7])
def test_a_bad_measurement_is_a_fault(arm: Xarm7, measured: list) -> None:
    run = Run(arm)
    run.act(SIDE)
    output = run.servo.step(measured, run.now)
    assert output.state is ServoState.FAULT
    assert "measured posture" in output.message
    assert np.isfinite(output.position).all()


def test_tracking_error_is_a_latched_fault(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(5):
        run.act(SIDE)
    output = run.servo.step(run.position + 0.21, run.now)
    assert output.state is ServoState.FAULT
    assert output.tracking_error == pytest.approx(0.21, abs=0.01)
    assert output.message.startswith("tracking error 0.2")
    run.step(50)
    assert run.outputs[-1].state is ServoState.FAULT  # latched
    assert run.outputs[-1].counters.faults == 1


# States ------------------------------------------------------------------------------------------


def test_fault_needs_a_reset_and_an_explicit_enable(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(5):
        run.act(SIDE)
    run.servo.fault("C31: collision")
    run.step()
    with pytest.raises(MoveRejected, match="still braking"):
        run.servo.reset_fault(run.position, run.now)
    with pytest.raises(ActionRejected, match="FAULT"):
        run.servo.submit(SIDE, STILL, run.now)
    with pytest.raises(MoveRejected, match="FAULT"):
        run.servo.move_to(arm.home, run.now)
    with pytest.raises(MoveRejected, match="expected DISABLED"):
        run.servo.enable(run.position, run.now)
    run.servo.disable()
    assert run.step(40).state is ServoState.FAULT
    assert run.outputs[-1].message == "C31: collision"
    run.assert_within_limits()
    elsewhere = run.position + 0.05  # pushed by hand meanwhile
    run.servo.reset_fault(elsewhere, run.now)
    assert run.servo.state is ServoState.DISABLED
    with pytest.raises(ActionRejected, match="DISABLED"):
        run.servo.submit(SIDE, STILL, run.now)
    run.servo.enable(elsewhere, run.now)
    np.testing.assert_array_equal(run.servo.step(elsewhere, run.now).position, elsewhere)


def test_reset_needs_a_fault_and_a_real_posture(arm: Xarm7) -> None:
    run = Run(arm)
    with pytest.raises(MoveRejected, match="expected FAULT"):
        run.servo.reset_fault(arm.home, run.now)
    run.servo.fault("x")
    with pytest.raises(MoveRejected, match="not finite"):
        run.servo.reset_fault([math.nan] * 7, run.now)
    assert run.servo.state is ServoState.FAULT


def test_disable_brakes_first_and_then_goes_silent(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(10):
        run.act(SIDE)
    run.servo.disable()
    assert run.step().active  # the arm must be told how to brake
    with pytest.raises(MoveRejected, match="still braking"):
        run.servo.enable(run.position, run.now)
    output = run.step(30)
    assert not output.active
    assert output.state is ServoState.DISABLED
    run.assert_within_limits()


def test_while_disabled_the_output_is_what_is_measured(arm: Xarm7) -> None:
    servo = CartesianServo(arm)
    measured = arm.home - 0.3
    output = servo.step(measured, 0.0)
    assert not output.active
    np.testing.assert_array_equal(output.position, measured)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({3: 4.0}, "joint4 4.0000 rad, limits -0.1050..3.9270"),
        ({1: -2.05}, "joint2"),
        ({0: math.pi}, "TCP x .* workspace box 0.2..0.75"),
        ({2: math.nan}, "not finite"),
    ],
)
def test_start_outside_the_limits_is_refused(arm: Xarm7, change: dict, message: str) -> None:
    servo = CartesianServo(arm)
    start = arm.home.copy()
    for joint, value in change.items():
        start[joint] = value
    with pytest.raises(MoveRejected, match=message):
        servo.enable(start, 0.0)
    assert servo.state is ServoState.DISABLED


def test_enable_twice_is_refused(arm: Xarm7) -> None:
    run = Run(arm)
    with pytest.raises(MoveRejected, match="READY"):
        run.servo.enable(arm.home, run.now)


def test_a_start_inside_the_boxs_margin_is_not_pulled_inwards(arm: Xarm7) -> None:
    floor = arm.fk_tcp(arm.home).position[2] - 0.001
    config = ServoConfig(box_lower=(0.2, -0.4, floor), box_margin=0.01)
    run = Run(arm, config)
    for _ in range(20):
        run.act(STILL)
    assert np.abs(run.joints() - arm.home).max() < 1e-9


def test_a_ruckig_error_brakes_along_the_known_stop(
    arm: Xarm7, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(arm)
    for _ in range(10):
        run.act(SIDE)

    def fail(request: object) -> None:
        raise TrajectoryError("Ruckig: Error")

    monkeypatch.setattr(run.servo._motion, "_sample", fail)
    output = run.act(SIDE)
    assert output.state is ServoState.FAULT
    assert output.message == "Ruckig: Error"
    run.step(30)
    assert speed(run) == 0.0
    run.assert_within_limits()


# move_to -----------------------------------------------------------------------------------------


def finish_goal(run: Run) -> None:
    for _ in range(2000):
        if run.step().goal is not GoalState.RUNNING:
            return
    raise AssertionError("the goal did not end")


def test_move_to_joints_arrives_exactly(arm: Xarm7) -> None:
    run = Run(arm)
    goal = arm.home + np.array([0.3, 0.1, -0.2, 0.1, 0.2, -0.1, 0.5])
    run.servo.move_to(goal, run.now, speed_scale=0.5)
    first = run.step()
    assert first.state is ServoState.MOVING
    assert first.goal_remaining == pytest.approx(0.5, abs=0.01)
    finish_goal(run)
    last = run.outputs[-1]
    assert (last.state, last.goal, last.goal_remaining) == (ServoState.READY, GoalState.REACHED, 0)
    np.testing.assert_allclose(last.position, goal, atol=1e-12)
    speeds = np.abs(np.diff(run.joints(), axis=0)) / 0.01
    assert speeds.max() <= 0.5 * run.servo.config.joint_velocity * (1 + 1e-9)
    run.assert_within_limits()


def test_move_to_pose_then_actions_go_on_from_there(arm: Xarm7) -> None:
    run = Run(arm)
    goal = Pose(np.array([0.5, 0.1, 0.1]), np.array([1.0, 0.0, 0.0, 0.0]))
    run.servo.move_to(goal, run.now)
    with pytest.raises(ActionRejected, match="move_to"):
        run.servo.submit(SIDE, STILL, run.now)
    finish_goal(run)
    np.testing.assert_allclose(run.servo.commanded_pose.position, goal.position, atol=1e-7)
    for _ in range(4):
        run.act(SIDE)
    for _ in range(20):
        run.act(STILL)
    expected = goal.position + 4 * SIDE
    np.testing.assert_allclose(run.servo.commanded_pose.position, expected, atol=1e-6)
    run.assert_within_limits()


def test_move_to_at_full_speed_keeps_the_tcp_speed_limit(arm: Xarm7) -> None:
    run = Run(arm)
    goal = arm.home.copy()
    goal[0] = 0.7
    run.servo.move_to(goal, run.now, speed_scale=1.0)
    finish_goal(run)
    assert run.outputs[-1].goal is GoalState.REACHED
    speeds = np.linalg.norm(np.diff(run.tcp(), axis=0), axis=1) / 0.01
    assert 0.4 < speeds.max() <= 0.5
    run.assert_within_limits()


def test_cancel_brakes_and_is_ready(arm: Xarm7) -> None:
    run = Run(arm)
    run.servo.move_to(arm.home + 0.3, run.now)
    run.step(30)
    assert speed(run) > 0.1
    run.servo.cancel()
    output = run.step(30)
    assert (output.state, output.goal) == (ServoState.READY, GoalState.CANCELLED)
    assert speed(run) == 0.0
    run.assert_within_limits()


@pytest.mark.parametrize(
    ("goal", "scale", "message"),
    [
        ([0.0] * 6, 0.3, "goal: shape"),
        ([math.nan] * 7, 0.3, "goal: not finite"),
        ([0, 0, 0, 5.0, 0, 0, 0], 0.3, "joint4 5.0000 rad"),
        ([0, 0, 0, 0.1, 0, 0.1, 0], 0.3, "workspace box"),
        (Pose(np.array([1.5, 0, 0.2]), np.array([1.0, 0, 0, 0])), 0.3, "no posture"),
        (Pose(np.array([0.5, 0, 0.2]), np.array([1.0, 0, 0, 0])), 0.0, "speed_scale"),
        (Pose(np.array([0.5, 0, 0.2]), np.array([1.0, 0, 0, 0])), math.nan, "speed_scale"),
    ],
)
def test_bad_goals_are_refused(arm: Xarm7, goal: object, scale: float, message: str) -> None:
    run = Run(arm)
    with pytest.raises(MoveRejected, match=message):
        run.servo.move_to(goal, run.now, scale)
    assert run.step().state is ServoState.READY


def test_a_way_out_of_the_box_is_refused_before_it_begins(arm: Xarm7) -> None:
    left = arm.ik(Pose(np.array([0.3, 0.35, 0.1]), np.array([1.0, 0, 0, 0])), arm.home)
    right = arm.ik(Pose(np.array([0.3, -0.35, 0.1]), np.array([1.0, 0, 0, 0])), arm.home)
    config = ServoConfig(box_upper=(0.4, 0.4, 0.6))  # the arc between them bulges out in x
    run = Run(arm, config, left)
    with pytest.raises(MoveRejected, match="the way leaves"):
        run.servo.move_to(right, run.now)
    np.testing.assert_array_equal(run.step(10).position, left)


def test_move_to_waits_for_a_standing_arm(arm: Xarm7) -> None:
    run = Run(arm)
    for _ in range(10):
        run.act(SIDE)
    with pytest.raises(MoveRejected, match="is moving"):
        run.servo.move_to(arm.home, run.now)
    run.step(40)  # halted
    run.servo.move_to(arm.home, run.now)
    finish_goal(run)
    np.testing.assert_allclose(run.position, arm.home, atol=1e-12)


def test_fault_aborts_a_goal(arm: Xarm7) -> None:
    run = Run(arm)
    run.servo.move_to(arm.home + 0.2, run.now)
    run.step(20)
    run.servo.fault("C2: emergency stop")
    assert run.step(40).goal is GoalState.ABORTED
    run.assert_within_limits()


# Settings ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {"period": 0.0},
        {"action_timeout": math.nan},
        {"joint_jerk": -1.0},
        {"box_lower": (0.2, math.inf, 0.0)},
        {"box_lower": (0.9, -0.4, 0.0)},
        {"box_margin": -0.1},
        {"period": 0.2},
        {"smoothing": 0.01},
        {"tcp_speed_limit": 0.1},
    ],
)
def test_bad_settings_are_refused_by_name(values: dict) -> None:
    name = next(iter(values)).removesuffix("_lower").removesuffix("_upper")
    with pytest.raises(ValueError, match=name):
        ServoConfig(**values)
