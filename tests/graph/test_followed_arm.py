"""A simulated block under a real arm's fingers: what moves them, and what must not."""

import math

import numpy as np
import pytest
from codesign_nodes.followed_arm import STALE, FollowedArm
from codesign_nodes.simulated_cell import CATCH_UP_SPEED, CellConfig, SimulatedCell

from codesign_control import Pose, Xarm7
from codesign_control.grasp_frame import start_posture
from codesign_control.gripper import GripperModel
from codesign_design.stock import stock_fingers
from codesign_policy.domain import TrialDomain, draw_domain

TICK = 0.01  # s
WIDTH = 0.06  # m
DOMAIN = draw_domain(0, TrialDomain(x=0.45, y=0.0))
HOME = start_posture(Xarm7(), GripperModel(), WIDTH)


@pytest.fixture(scope="module")
def simulated() -> SimulatedCell:
    return SimulatedCell(CellConfig(tetrahedra=600), stock_fingers())


@pytest.fixture
def cell(simulated: SimulatedCell) -> SimulatedCell:
    """A block under an arm that stands at home."""
    simulated.stand(HOME, WIDTH)
    simulated.place_block(DOMAIN)
    return simulated


def reaching(x: float, y: float, z: float) -> np.ndarray:
    """Joints (7,) [rad] that hold the grasp frame there [m], fingers down, at the gap WIDTH."""
    arm, gripper = Xarm7(), GripperModel()
    tcp = arm.fk_tcp(HOME)
    down = np.array([x, y, z + gripper.finger_z(WIDTH)])
    return arm.ik(Pose(down, tcp.quaternion), HOME)


def block_at(cell: SimulatedCell) -> np.ndarray:
    return cell.simulator.object_pose()[0][0]


def test_fingers_are_where_the_arm_holds_them(cell: SimulatedCell) -> None:
    before, turned = cell.grasp_pose()[0], HOME + 0.003 * np.eye(7)[0]
    cell.follow(turned, 0.059)
    assert cell.behind
    cell.tick(TICK)
    assert not cell.behind
    np.testing.assert_array_equal(cell.joint_position, turned)
    assert cell.gripper.width == 0.059
    assert cell.grasp_pose()[0][1] - before[1] == pytest.approx(0.003 * 0.45, rel=0.01)


def test_a_gap_beyond_the_fingers_limits_is_clipped(cell: SimulatedCell) -> None:
    cell.follow(HOME, 0.2)
    for _ in range(10):
        cell.tick(TICK)
    assert cell.gripper.width == cell.gripper.max_width
    assert not cell.behind


@pytest.mark.parametrize(
    ("joints", "width"),
    [(np.full(7, math.nan), WIDTH), (HOME[:6], WIDTH), (HOME, math.nan), (HOME, math.inf)],
)
def test_nonsense_moves_nothing(cell: SimulatedCell, joints: np.ndarray, width: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        cell.follow(joints, width)
    cell.tick(TICK)
    np.testing.assert_array_equal(cell.joint_position, HOME)


@pytest.mark.parametrize("height", [0.005, 0.02])
def test_a_jump_of_the_reports_pushes_the_block(cell: SimulatedCell, height: float) -> None:
    """From one side of the block to the other between two reports."""
    here, there = reaching(0.45, -0.10, height), reaching(0.45, 0.10, height)
    cell.stand(here, WIDTH)
    cell.place_block(DOMAIN)
    cell.follow(there, WIDTH)
    places, deepest = [cell.grasp_pose()[0]], 0.0
    for _ in range(120):
        cell.tick(TICK)
        places.append(cell.grasp_pose()[0])
        deepest = max(deepest, float(cell.simulator.contact().finger_penetration[0]))
    assert not cell.behind
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert 0.8 * CATCH_UP_SPEED * TICK < steps[:50].max() < 1.05 * CATCH_UP_SPEED * TICK
    # The left finger, 7 mm thick, comes first and takes the block along on its outer side.
    assert deepest < 0.002
    assert block_at(cell)[1] > places[-1][1] + WIDTH / 2.0


def test_standing_fingers_let_the_block_go_on(cell: SimulatedCell) -> None:
    cell.follow(HOME + 0.5, WIDTH)
    cell.tick(TICK)
    cell.stand_still()
    stood = cell.joint_position.copy()
    for _ in range(5):
        cell.tick(TICK)
    np.testing.assert_array_equal(cell.joint_position, stood)
    assert cell.simulator.time == pytest.approx(6 * TICK)


def test_a_block_needs_room_between_and_under_the_fingers(cell: SimulatedCell) -> None:
    fingers = stock_fingers()
    cell.require_room(DOMAIN, HOME, WIDTH, fingers)
    around = reaching(0.45, 0.0, 0.005)
    cell.require_room(DOMAIN, around, WIDTH, fingers)  # 15 mm on either side
    with pytest.raises(ValueError, match=r"fingers are where the block is to stand.*move the arm"):
        cell.require_room(DOMAIN, around, 0.035, fingers)
    with pytest.raises(ValueError, match="fingers are where the block is to stand"):
        cell.require_room(DOMAIN, reaching(0.45, 0.03, 0.02), WIDTH, fingers)


# --- reports


def test_reports_are_read_a_little_later_without_their_jitter() -> None:
    arm, random = FollowedArm(), np.random.default_rng(0)
    for k in range(40):
        arm.add_joints(0.01 * k, np.full(7, 0.01 * k), now=0.01 * k + random.uniform(0.0, 0.02))
        if k % 5 == 0:
            arm.add_width(0.01 * k, 0.06 - 0.001 * k, now=0.01 * k)
    joints, width = arm.at(0.325)
    np.testing.assert_allclose(joints, 0.325)
    assert width == pytest.approx(0.06 - 0.0325)


def test_what_is_old_or_never_came_is_named() -> None:
    arm = FollowedArm()
    assert arm.missing(1.0) == "no /joint_states yet, no /gripper_state yet"
    arm.add_joints(1.0, HOME, now=1.0)
    assert arm.missing(1.0) == "no /gripper_state yet"
    arm.add_width(1.0, WIDTH, now=1.0)
    assert not arm.missing(1.0 + STALE)
    arm.add_width(2.0, WIDTH, now=2.0)
    assert arm.missing(2.0) == "no /joint_states for 1.0 s"


def test_reports_that_are_not_finite_are_none() -> None:
    arm = FollowedArm()
    arm.add_width(0.0, WIDTH, now=0.0)
    for joints in (np.full(7, math.nan), HOME[:5]):
        with pytest.raises(ValueError, match="joint command"):
            arm.add_joints(0.0, joints, now=0.0)
    with pytest.raises(ValueError, match="not finite"):
        arm.add_width(0.1, math.nan, now=0.1)
    assert arm.missing(0.1) == "no /joint_states yet"
