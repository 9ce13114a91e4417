"""The last gate on its own: asked for the worst, it keeps every limit and can always stop."""

import numpy as np
import pytest

from codesign_control import ServoConfig, Xarm7
from codesign_control.motion import JointMotion, JointState

CONFIG = ServoConfig()


def assert_within_limits(arm: Xarm7, positions: list[np.ndarray]) -> None:
    q, dt = np.array(positions), CONFIG.period
    tcp = np.array([arm.tcp_placement(row).translation for row in q])
    assert (q >= arm.lower).all()
    assert (q <= arm.upper).all()
    assert (tcp >= CONFIG.box_lower).all()
    assert (tcp <= CONFIG.box_upper).all()
    limits = (CONFIG.joint_velocity, CONFIG.joint_acceleration, CONFIG.joint_jerk)
    for order, limit in enumerate(limits, start=1):
        assert np.abs(np.diff(q, order, axis=0)).max() / dt**order <= limit * (1 + 1e-6)
    assert np.linalg.norm(np.diff(tcp, axis=0), axis=1).max() / dt <= 0.5 * (1 + 1e-6)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("speed", [1.2, 50.0])
def test_hostile_joint_velocities(arm: Xarm7, seed: int, speed: float) -> None:
    random = np.random.default_rng(seed)
    motion = JointMotion(arm, CONFIG, arm.home)
    positions, refused = [arm.home] * 3, 0
    for tick in range(600):
        if tick % 37 == 0:
            velocity = speed * random.choice([-1.0, 0.0, 1.0], size=7)
        refused += not motion.follow_velocity(velocity)
        positions.append(motion.state.position)
    assert refused > 0  # else this asked for nothing that is forbidden
    while not motion.state.at_rest:
        motion.brake()
        positions.append(motion.state.position)
    assert_within_limits(arm, positions)


EVERYWHERE = ServoConfig(
    box_lower=(-2, -2, -2), box_upper=(2, 2, 2), tcp_speed_limit=5.0, table_height=-2.0
)


def start_of_a_clear_way(arm: Xarm7, joint: int, sign: float) -> np.ndarray:
    """A posture from which no link comes near another one while a joint turns to its end."""
    motion, random = JointMotion(arm, EVERYWHERE, arm.home), np.random.default_rng(joint)
    end = (arm.upper if sign > 0 else arm.lower)[joint]
    for _ in range(1000):
        posture = random.uniform(np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0))
        way = np.repeat(posture[None], 9, axis=0)
        way[:, joint] = np.linspace(end - sign * 0.4, end, 9)
        if all(motion.clearance.clear(q) for q in way):
            return way[0]
    raise AssertionError(f"no clear way to the end of joint {joint + 1}")


# At the other two ends the arm meets itself first: J4 folds the wrist onto the shoulder, J6 the
# gripper onto the forearm.
@pytest.mark.parametrize(
    ("joint", "sign"),
    [(j, s) for j in range(7) for s in (-1.0, 1.0) if (j, s) not in ((3, -1.0), (5, 1.0))],
)
def test_stops_before_the_joint_limits(arm: Xarm7, joint: int, sign: float) -> None:
    start = start_of_a_clear_way(arm, joint, sign)
    motion = JointMotion(arm, EVERYWHERE, start)
    velocity = np.zeros(7)
    velocity[joint] = sign * 1.2
    for _ in range(200):
        motion.follow_velocity(velocity)
        assert arm.within_limits(motion.state.position)
    limit = (arm.upper if sign > 0 else arm.lower)[joint]
    assert abs(limit - motion.state.position[joint]) < 0.02  # and not long before


def test_stops_at_the_announced_place(arm: Xarm7) -> None:
    motion = JointMotion(arm, CONFIG, arm.home)
    for _ in range(20):
        motion.follow_velocity(np.array([0.5, -0.1, 0.2, 0.1, -0.3, 0.2, 1.0]))
    announced = motion.stop_position.copy()
    for _ in range(15):
        motion.brake()
    assert motion.state.at_rest
    np.testing.assert_array_equal(motion.state.position, announced)


def test_what_is_not_a_number_brakes(arm: Xarm7) -> None:
    motion = JointMotion(arm, CONFIG, arm.home)
    for _ in range(10):
        motion.follow_velocity(np.full(7, 0.1))
    announced = motion.stop_position.copy()
    assert not motion.follow_velocity(np.full(7, np.nan))
    for _ in range(15):
        assert not motion.follow(JointState.standing(np.full(7, np.nan)))
    np.testing.assert_array_equal(motion.state.position, announced)
