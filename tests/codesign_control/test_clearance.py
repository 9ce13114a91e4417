"""Capsules enclose the arm, their distances are right, and the servo keeps them apart."""

import xml.etree.ElementTree as ElementTree

import numpy as np
import pinocchio as pin
import pytest
from servo_run import STILL, Run

from codesign_control import GripperModel, Hand, Limit, MoveRejected, Pose, ServoConfig, Xarm7, urdf
from codesign_control.capsules import (
    LEFT_ALONE,
    Capsule,
    arm_capsules,
    hand_capsules,
    placed,
    watched_pairs,
)
from codesign_control.clearance import REACH, Clearance, HandHeight
from codesign_control.driver import DriverConfig
from codesign_control.limit_check import link_placements, segment_distance

ARM = Xarm7()
CONFIG = ServoConfig()
NO_TABLE = ServoConfig(box_lower=(-1.2, -1.2, -0.6), box_upper=(1.2, 1.2, 1.6), table_height=-1.0)
CAPSULES = arm_capsules() + hand_capsules(Hand())


def postures(count: int, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.uniform(np.maximum(ARM.lower, -3.0), np.minimum(ARM.upper, 3.0), (count, 7))


def inside(capsules: list[Capsule], points: np.ndarray) -> np.ndarray:
    """Whether each (n, 3) point lies in at least one capsule."""
    found = np.zeros(len(points), dtype=bool)
    for capsule in capsules:
        segment = np.repeat([[capsule.start, capsule.end]], len(points), axis=0)
        distance = segment_distance(np.stack([points, points], axis=1), segment)
        found |= distance <= capsule.radius + 1e-9
    return found


def test_every_drawn_shape_lies_within_the_capsules_of_its_link() -> None:
    random = np.random.default_rng(0)
    for link in ElementTree.fromstring(urdf()).iter("link"):
        for shape in link.iter("collision"):
            solid, origin = shape.find("geometry")[0], shape.find("origin")
            unit = random.uniform(-1.0, 1.0, (2000, 3))
            if solid.tag == "box":
                points = unit * np.array(solid.get("size").split(), dtype=float) / 2.0
            else:
                ring = unit[:, :2] / np.linalg.norm(unit[:, :2], axis=1)[:, None]
                points = np.column_stack([ring * float(solid.get("radius")), unit[:, 2]])
                points[:, 2] *= float(solid.get("length", "0")) / 2.0
            turn = pin.rpy.rpyToMatrix(*map(float, origin.get("rpy", "0 0 0").split()))
            points = points @ turn.T + np.array(origin.get("xyz").split(), dtype=float)
            own = [capsule for capsule in CAPSULES if capsule.link == link.get("name")]
            assert inside(own, points).all(), link.get("name")


@pytest.mark.parametrize("width", [0.0, 0.012, 0.03, 0.084])
def test_the_fingers_lie_within_their_capsules_at_any_gap(width: float) -> None:
    own = [capsule for capsule in CAPSULES if capsule.link == "fingers"]
    assert inside(own, Hand().corners(width)).all()


def test_distances_are_those_of_an_independent_computation() -> None:
    clearance, pairs, worst = Clearance(CONFIG, Hand()), watched_pairs(CAPSULES), 0.0
    for q in postures(60):
        links = link_placements(q[None])
        ends = {
            k: np.array([links[link][0][0] @ end + links[link][1][0] for end in (start, stop)])
            for k, (link, start, stop) in enumerate(map(placed, CAPSULES))
        }
        distances = [
            segment_distance(ends[i], ends[j]) - CAPSULES[i].radius - CAPSULES[j].radius
            for i, j in pairs
        ]
        room = clearance.room(q)[: clearance.self_pairs] + CONFIG.self_collision_margin
        separate = np.array(distances) > 1e-3  # overlapping axes have no unique depth
        worst = max(worst, np.abs(room - distances)[separate].max())
        assert (room[~separate] < 2e-3).all()
        assert clearance.clear(q) == (clearance.room(q).min() >= 0.0)
    assert worst < 1e-9


def test_an_elbow_folded_onto_the_foot_collides_and_home_does_not() -> None:
    clearance, folded = Clearance(NO_TABLE, Hand()), ARM.home.copy()
    folded[3] = 0.2  # the hand on its way into the base
    assert clearance.clear(ARM.home)
    assert not clearance.clear(folded)
    assert "link_base" in clearance.describe(clearance.room(folded))


def test_the_gradient_is_that_of_finite_differences() -> None:
    clearance = Clearance(CONFIG, Hand())
    for q in postures(20, seed=1):
        room = clearance.room(q)
        apart = np.flatnonzero((room > 0.0) & (room < 0.2))
        if not len(apart):
            continue
        slopes = clearance.gradient(q, apart)
        numeric = [clearance.room(q + 1e-6 * e) - clearance.room(q - 1e-6 * e) for e in np.eye(7)]
        np.testing.assert_allclose(slopes, np.array(numeric).T[apart] / 2e-6, atol=1e-6)


def test_no_distance_changes_faster_than_the_bound() -> None:
    clearance, random = Clearance(CONFIG, Hand()), np.random.default_rng(2)
    for q in postures(100, seed=3):
        turned = 0.05 * random.normal(size=7)
        change = np.abs(clearance.room(q + turned) - clearance.room(q))
        assert (change <= clearance.fastest(turned) + 1e-12).all()
    assert REACH.shape == (7,)


def test_pairs_left_alone_depend_on_one_joint_or_are_never_near() -> None:
    """Of LEFT_ALONE: the far ones stay far."""
    far = [
        (i, j)
        for i, a in enumerate(CAPSULES)
        for j, b in enumerate(CAPSULES)
        if (a.body, b.body) in LEFT_ALONE - {(0, 2), (2, 4), (4, 6)}
    ]
    links = link_placements(postures(2000, seed=4))
    ends = np.array(
        [
            [links[link][0] @ end + links[link][1] for end in (start, stop)]
            for link, start, stop in map(placed, CAPSULES)
        ]
    ).transpose(2, 0, 1, 3)
    first, second = np.array(far).T
    radii = np.array([capsule.radius for capsule in CAPSULES])
    apart = segment_distance(ends[:, first], ends[:, second]) - radii[first] - radii[second]
    assert apart.min() > 0.05


def test_no_gap_between_two_brings_the_fingers_lower_than_the_room_says() -> None:
    """The four-bar's arc bulges towards the table between the gaps that stand for all."""
    hand, random = long_hand(), np.random.default_rng(5)
    height = HandHeight(CONFIG, hand)
    for _ in range(200):
        low = random.uniform(hand.gripper.min_width, hand.gripper.max_width - 0.012)
        high = low + random.uniform(0.0, 0.012)
        down = pin.rpy.rpyToMatrix(np.pi + random.normal() / 3.0, random.normal() / 3.0, 0.0)
        path = pin.SE3(down, np.array([0.45, 0.0, 0.2])).homogeneous[None]
        said = height.least(path, (low, high))[0]
        between = [height.least(path, (width, width))[0] for width in np.linspace(low, high, 13)]
        assert min(between) - 2e-5 < said <= min(between) + 1e-12


# In the servo -------------------------------------------------------------------------------------


def test_the_arm_stops_before_itself_and_backs_out() -> None:
    """Drawn in towards its foot until the hand meets the base or a link."""
    run = Run(ARM, NO_TABLE)
    for _ in range(120):
        run.act(np.array([-0.01, 0.0, -0.002]))
    assert any(output.limits & Limit.SELF_COLLISION for output in run.outputs)
    near = run.servo.proximity().self_distance
    assert CONFIG.self_collision_margin - 1e-7 <= near < 0.03
    stood = run.servo.commanded_pose.position
    for _ in range(40):
        run.act(np.array([0.01, 0.0, 0.002]))
    assert np.linalg.norm(run.servo.commanded_pose.position - stood) > 0.05
    assert run.servo.proximity().self_distance > near
    run.assert_within_limits()


def test_starts_and_goals_too_near_are_refused_by_name() -> None:
    folded = ARM.home.copy()
    folded[3] = 0.2
    run = Run(ARM, NO_TABLE)
    with pytest.raises(MoveRejected, match=r"link_base and \w+ -?[\d.]+ mm apart, at least 10"):
        run.servo.move_to(folded, run.now)
    with pytest.raises(MoveRejected, match="mm apart"):
        Run(ARM, NO_TABLE, folded)


def long_hand() -> Hand:
    from codesign_control.adversary import _hands

    return _hands()[1]


def with_hand(hand: Hand, width: float, config: ServoConfig = CONFIG) -> Run:
    run = Run(ARM, config)
    run.servo.disable()
    run.servo.set_hand(hand)
    run.servo.observe_gripper(width)
    run.servo.enable(ARM.home, run.now)
    return run


@pytest.mark.parametrize("turn", [[0, 0, 0], [0.02, 0, 0], [0, -0.02, 0], [0.01, 0.01, 0.03]])
def test_long_fingers_stop_at_the_table_however_the_hand_turns(turn: list[float]) -> None:
    hand = long_hand()
    run = with_hand(hand, 0.06)
    for _ in range(30):
        run.act(np.array([0.0, 0.0, -0.0125]), np.array(turn))
    lowest = []
    for output in run.outputs:
        tcp = ARM.tcp_placement(output.position)
        lowest.append((hand.corners(0.06) @ tcp.rotation.T + tcp.translation)[:, 2].min())
    assert -1e-9 <= min(lowest) < (0.02 if any(turn) else 2e-4)  # a tilted gripper is wide
    assert any(output.limits & Limit.TABLE for output in run.outputs)
    low = run.servo.commanded_pose.position[2]
    for _ in range(20):
        run.act(np.array([0.0, 0.0, 0.01]), -np.array(turn))
    assert run.servo.commanded_pose.position[2] > low + 0.08  # backs out


def test_the_table_may_be_anywhere() -> None:
    config = ServoConfig(table_height=0.1, box_lower=(0.2, -0.4, 0.1))
    run = with_hand(long_hand(), 0.0, config)
    for _ in range(40):
        run.act(np.array([0.0, 0.0, -0.0125]))
    # 35.5 mm of finger below link_tcp when closed.
    assert run.servo.commanded_pose.position[2] == pytest.approx(0.1356, abs=2e-4)


def test_the_gripper_waits_until_the_arm_has_made_room() -> None:
    """Closing moves the fingers 12 mm forward: into the table, if the hand did not rise."""
    hand = long_hand()
    run = with_hand(hand, hand.gripper.max_width)
    for _ in range(40):
        run.act(np.array([0.0, 0.0, -0.0125]))
    run.servo.ask_gripper(0.0)
    waiting = run.step()
    assert waiting.gripper > 0.05
    assert waiting.counters.gripper_waits == 1
    for _ in range(10):
        run.act(np.array([0.0, 0.0, 0.005]), STILL)
    assert run.step().gripper == 0.0


LATE = round(DriverConfig().delay / CONFIG.period)  # ticks that set-points and targets are late


def lowered(hand: Hand, height: float) -> Run:
    """Stands with the opened fingers at a height [m] over the table."""
    opened = hand.gripper.max_width
    run = with_hand(hand, opened)
    above = run.servo.commanded_pose.position[2] - hand.corners(opened)[:, 2].max()
    for _ in range(30):
        run.act(np.array([0.0, 0.0, (height - above) / 30.0]))
    run.step(15)
    return run


def finger_height(hand: Hand, posture: np.ndarray, width: float) -> float:
    tcp = ARM.tcp_placement(posture)
    return float((hand.corners(width) @ tcp.rotation.T + tcp.translation)[:, 2].min())


def test_a_gripper_target_keeps_its_room_while_it_is_on_its_way() -> None:
    """The arm stands on the table, as low as closing lets it, when closing is taken back."""
    hand = long_hand()
    opened, closing = hand.gripper.max_width, hand.gripper.max_width - 0.01
    run = lowered(hand, 0.006)
    run.servo.ask_gripper(closing)
    for _ in range(10):
        run.act(np.array([0.0, 0.0, -0.0125]))
    assert finger_height(hand, run.position, closing) == pytest.approx(1e-4, abs=2e-5)
    run.servo.ask_gripper(opened)
    for _ in range(20):
        run.act(np.array([0.0, 0.0, -0.0125]))
    heights = [finger_height(hand, output.position, closing) for output in run.outputs[-100:]]
    assert min(heights[: 1 + LATE]) > 0.0  # the driver's gripper closes until then
    assert heights[2 * LATE] < 0.0
    assert finger_height(hand, run.position, opened) < 2e-4


def test_fingers_that_close_for_a_moment_behind_a_driver_stay_off_the_table() -> None:
    """On the way down: close, open again after 40 ms, and a driver to which it all comes late."""
    hand = long_hand()
    opened = hand.gripper.max_width
    run, gripper = lowered(hand, 0.004), GripperModel(width=opened)
    targets, heights = [opened] * LATE, []
    for tick in range(60):
        if tick % 5 == 0:
            run.servo.submit(np.array([0.0, 0.0, -0.0125]), STILL, run.now)
        if tick in (4, 8):
            run.servo.ask_gripper(opened - 0.01 if tick == 4 else opened)
        run.servo.observe_gripper(gripper.width)
        targets.append(run.step().gripper)
        reached = run.outputs[-1 - LATE].position
        heights += [finger_height(hand, reached, gap) for gap in (gripper.width, targets[tick])]
        gripper.step(targets[tick], CONFIG.period, 0.2)
    assert min(targets) < opened - 0.005
    assert min(heights) > 0.0  # -12 um without room for what is on its way
    assert heights[-1] < 3e-4


def test_a_start_below_the_table_is_refused_with_the_reason() -> None:
    above = ARM.fk_tcp(ARM.home)
    low = ARM.ik(Pose(np.array([0.45, 0.0, 0.003]), above.quaternion), ARM.home)
    # The gap is not known yet: nearly closed, the stock fingers reach 6.1 mm below link_tcp.
    with pytest.raises(MoveRejected, match=r"hand 3\.1 mm too low over the table"):
        Run(ARM, CONFIG, low)


def test_fingers_change_only_while_disabled() -> None:
    with pytest.raises(MoveRejected, match="set_hand: state is READY"):
        Run(ARM).servo.set_hand(long_hand())
