"""No action stream makes a set-point break a limit: measured on the set-points themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from servo_run import PATTERNS, STILL, Run, hostile

from codesign_control import ActionRejected, MoveRejected, ServoConfig, ServoState, Xarm7

ARM = Xarm7()
EVERYWHERE = {"box_lower": (-1.2, -1.2, -0.6), "box_upper": (1.2, 1.2, 1.6), "table_height": -0.6}
ON_THE_TABLE = ServoConfig()
ALL_ROUND = ServoConfig(**EVERYWHERE)


def started(config: ServoConfig, random: np.random.Generator) -> Run:
    """A run from a random posture: near home, or anywhere where the box lets it."""
    while True:
        if config is ALL_ROUND:
            start = random.uniform(np.maximum(ARM.lower, -3.0), np.minimum(ARM.upper, 3.0))
        else:
            start = ARM.home + 0.3 * random.normal(size=7)
        try:
            return Run(ARM, config, start)
        except MoveRejected:
            continue


@pytest.mark.parametrize("config", [ON_THE_TABLE, ALL_ROUND], ids=["table", "all round"])
@pytest.mark.parametrize("pattern", PATTERNS)
def test_hostile_streams_stay_within_every_limit_and_stop(
    pattern: str, config: ServoConfig
) -> None:
    for seed in range(2):
        random = np.random.default_rng(seed)
        run = started(config, random)
        actions = hostile(pattern, random, config)
        for _ in range(120):
            run.act(*next(actions))
        run.step(round((0.3 - config.action_period) / config.period))
        assert np.abs(run.outputs[-1].velocity).max() == 0.0  # stands 300 ms after the last action
        assert run.outputs[-1].counters.faults == 0
        run.assert_within_limits()


def test_100_000_actions_at_once_and_out_of_time() -> None:
    """Floods, gaps and rubbish in one stream; 10^5 actions, 0 violations."""
    random = np.random.default_rng(7)
    run = started(ON_THE_TABLE, random)
    streams = [hostile(pattern, random, ON_THE_TABLE) for pattern in PATTERNS]
    rubbish = [np.full(3, np.nan), np.full(3, np.inf), np.full(3, 1e9), np.zeros(2)]
    sent = 0
    while sent < 100_000:
        stream = streams[random.integers(len(streams))]
        for _ in range(random.integers(1, 12)):  # ticks
            for _ in range(random.integers(1, 70)):  # actions within one tick
                sent += 1
                if random.random() < 0.1:
                    with pytest.raises(ActionRejected):
                        run.servo.submit(rubbish[random.integers(4)], STILL, run.now)
                else:
                    run.servo.submit(*next(stream), run.now)
            run.step()
        if random.random() < 0.1:
            run.step(int(random.integers(1, 60)))  # silence: halts, and goes on
    counters = run.outputs[-1].counters
    assert counters.actions_accepted + counters.actions_rejected == sent
    assert counters.halts > 0
    assert counters.faults == 0
    run.assert_within_limits()


number = st.one_of(st.floats(-0.05, 0.05), st.floats(allow_nan=True, allow_infinity=True))
vector = st.lists(number, min_size=2, max_size=4)
event = st.one_of(
    st.tuples(st.just("act"), vector, vector),
    st.tuples(st.just("wait"), st.integers(1, 40)),
    st.tuples(st.just("move_to"), st.lists(st.floats(-1.0, 1.0), min_size=7, max_size=7)),
    st.tuples(st.just("cancel")),
    st.tuples(st.just("fault")),
    st.tuples(st.just("recover")),
    st.tuples(st.just("disable")),
)


@given(st.lists(event, max_size=60))
@settings(max_examples=60, deadline=None)
def test_any_sequence_of_requests_stays_within_every_limit(events: list) -> None:
    run = Run(ARM)
    for name, *values in events:
        try:
            if name == "act":
                run.act(*values)
            elif name == "wait":
                run.step(*values)
            elif name == "move_to":
                run.servo.move_to(ARM.home + values[0], run.now)
                run.step(5)
            elif name == "cancel":
                run.servo.cancel()
            elif name == "fault":
                run.servo.fault("injected")
            elif name == "disable":
                run.servo.disable()
            elif run.servo.state is ServoState.FAULT:
                run.servo.reset_fault(run.position, run.now)
            else:
                run.servo.enable(run.position, run.now)
        except (ActionRejected, MoveRejected):
            pass
        run.step()
    if run.servo.state in (ServoState.MOVING, ServoState.HALTED):
        run.servo.disable()
    run.step(40)
    assert np.abs(run.outputs[-1].velocity).max() == 0.0
    run.assert_within_limits()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_box_keeps_the_tcp_in_and_lets_it_out_again(axis: int, sign: float) -> None:
    push = np.zeros(3)
    push[axis] = sign * 0.0125
    config = ServoConfig(box_lower=(0.35, -0.1, 0.15), box_upper=(0.55, 0.1, 0.35))
    run = Run(ARM, config)
    for _ in range(40):
        run.act(push)
    wall = (config.box_upper if sign > 0 else config.box_lower)[axis]
    inside = sign * (wall - run.servo.commanded_pose.position[axis])
    assert inside == pytest.approx(config.box_margin, abs=5e-4)
    for _ in range(8):
        run.act(-push)
    assert sign * (wall - run.servo.commanded_pose.position[axis]) > 0.05
    run.assert_within_limits()


def smallest_singular_value(q: np.ndarray) -> float:
    return float(np.linalg.svd(ARM.jacobian_tcp(q), compute_uv=False)[-1])


def test_singularity_slows_and_lets_back_out() -> None:
    """Straight out and up until the elbow is nearly stretched, then back."""
    run = Run(ARM, ALL_ROUND)
    out = np.array([0.008, 0.0, 0.008])
    for _ in range(120):
        run.act(out)
    scales = np.array([output.singularity_scale for output in run.outputs])
    nearness = np.array([smallest_singular_value(output.position) for output in run.outputs])
    assert scales[0] == 1.0
    assert scales.min() < 0.05
    assert nearness.min() > 0.9 * ALL_ROUND.singularity_stop
    assert speed_of(run)[-50:].max() < 0.01  # stands in front of it, without chatter
    stood = run.servo.commanded_pose.position
    for _ in range(20):
        run.act(-out)
    assert run.outputs[-1].singularity_scale == 1.0
    assert np.linalg.norm(run.servo.commanded_pose.position - stood) > 0.05
    run.assert_within_limits()


def speed_of(run: Run) -> np.ndarray:
    return np.linalg.norm(np.diff(run.tcp(), axis=0), axis=1) / run.servo.config.period


@pytest.mark.parametrize("about", [2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_joint_stops_short_of_its_limit_and_turns_back(about: int, sign: float) -> None:
    """Turning on the spot drives joint 7 to the end of its range."""
    start = ARM.home.copy()
    start[6] = -sign * 6.0  # tool z points down: a turn about base z moves J7 the other way
    run = Run(ARM, start=start)
    turn = np.zeros(3)
    turn[about] = sign * 0.05
    for _ in range(60):
        run.act(STILL, turn)
    room = np.minimum(run.joints() - ARM.lower, ARM.upper - run.joints())[:, 6]
    assert 0.0 < room.min() < 0.03
    for _ in range(20):
        run.act(STILL, -turn)
    assert np.minimum(run.position - ARM.lower, ARM.upper - run.position)[6] > 0.3
    run.assert_within_limits()
