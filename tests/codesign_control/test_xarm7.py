"""Kinematics against an independent model, finite differences and itself."""

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from codesign_control import IkError, Pose, Xarm7, urdf

DATA = Path(__file__).parent / "data" / "xarm7_forward_kinematics.json"
ARM = Xarm7()


def independent_poses() -> list[dict]:
    return json.loads(DATA.read_text(encoding="utf-8"))["poses"]


def postures(margin: float = 0.05) -> st.SearchStrategy[np.ndarray]:
    """Joint vectors inside the limits, one turn at most."""
    low, high = np.maximum(ARM.lower, -np.pi) + margin, np.minimum(ARM.upper, np.pi) - margin
    joints = [st.floats(lo, hi) for lo, hi in zip(low, high, strict=True)]
    return st.tuples(*joints).map(np.array)


def test_flange_equals_the_independent_model(arm: Xarm7) -> None:
    poses = independent_poses()
    assert len(poses) == 100
    for pose in poses:
        flange = arm.fk_flange(pose["q_rad"])
        np.testing.assert_allclose(flange.position, pose["flange_position_m"], atol=1e-9)
        np.testing.assert_allclose(flange.rotation, pose["flange_rotation"], atol=1e-9)


def test_tcp_is_172_mm_along_the_flanges_z(arm: Xarm7) -> None:
    q = np.array([0.3, -0.4, 0.5, 1.2, -0.6, 0.9, 2.0])
    flange, tcp = arm.fk_flange(q), arm.fk_tcp(q)
    np.testing.assert_allclose(tcp.position, flange.position + 0.172 * flange.rotation[:, 2])
    np.testing.assert_allclose(tcp.quaternion, flange.quaternion)


@given(postures())
@settings(max_examples=50, deadline=None)
def test_jacobian_equals_finite_differences(q: np.ndarray) -> None:
    step = 1e-6
    jacobian = ARM.jacobian_tcp(q)
    for joint in range(7):
        change = step * np.eye(7)[joint]
        before, after = ARM.tcp_placement(q - change), ARM.tcp_placement(q + change)
        linear = (after.translation - before.translation) / (2 * step)
        angular = pin.log3(after.rotation @ before.rotation.T) / (2 * step)
        np.testing.assert_allclose(jacobian[:, joint], [*linear, *angular], atol=1e-8)


def test_home_points_down_over_the_table_clear_of_limits(arm: Xarm7) -> None:
    tcp = arm.fk_tcp(arm.home)
    np.testing.assert_allclose(tcp.position, [0.45, 0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose(tcp.rotation[:, 2], [0.0, 0.0, -1.0], atol=1e-6)
    assert arm.within_limits(arm.home, margin=0.7)


@given(postures(), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_ik_reaches_every_reachable_pose(q: np.ndarray, seed: int) -> None:
    target = ARM.fk_tcp(q)
    near = q + np.random.default_rng(seed).uniform(-0.5, 0.5, 7)
    solution = ARM.ik(target, near)
    assert ARM.within_limits(solution)
    reached = ARM.fk_tcp(solution)
    np.testing.assert_allclose(reached.position, target.position, atol=1e-7)
    np.testing.assert_allclose(reached.rotation, target.rotation, atol=1e-7)


def test_ik_from_its_own_answer_stays_there(arm: Xarm7) -> None:
    np.testing.assert_array_equal(arm.ik(arm.fk_tcp(arm.home), arm.home), arm.home)


def test_ik_says_how_far_it_misses(arm: Xarm7) -> None:
    far = Pose(np.array([1.5, 0.0, 0.3]), np.array([1.0, 0.0, 0.0, 0.0]))
    with pytest.raises(IkError, match=r"nearest miss 0\.\d+ m"):
        arm.ik(far, arm.home)


def test_limits_are_those_of_serials_from_1305(arm: Xarm7) -> None:
    two_pi = 2 * np.pi
    assert arm.names == [f"joint{i}" for i in range(1, 8)]
    lower = [-two_pi, -2.042, -two_pi, -0.105, -two_pi, -1.693, -two_pi]
    np.testing.assert_allclose(arm.lower, lower)
    upper = [two_pi, 2.025, two_pi, 3.927, two_pi, np.pi, two_pi]
    np.testing.assert_allclose(arm.upper, upper)
    np.testing.assert_allclose(arm.velocity, 3.14)
    np.testing.assert_allclose(arm.effort, [50, 50, 30, 30, 30, 20, 20])


def test_urdf_draws_every_link_in_primitives() -> None:
    robot = ElementTree.fromstring(urdf())
    links = {link.get("name"): link for link in robot.findall("link")}
    frames = {"link_base", *(f"link{i}" for i in range(1, 8)), "link_eef", "gripper_base_link"}
    assert set(links) == frames | {"link_tcp"}
    assert not list(robot.iter("mesh"))
    for name in frames - {"link_eef"}:
        assert links[name].findall("visual")
        assert links[name].findall("collision")
    masses = [float(links[f"link{i}"].find("inertial/mass").get("value")) for i in range(1, 8)]
    assert masses == [2.382, 1.869, 1.638, 1.727, 1.320, 1.325, 0.17]


def test_urdf_inertias_are_physical() -> None:
    model = pin.buildModelFromXML(urdf())
    for inertia in list(model.inertias)[1:]:
        principal = np.sort(np.linalg.eigvalsh(inertia.inertia))
        assert principal[0] > 0
        assert principal[2] <= principal[0] + principal[1]


def test_urdf_is_the_same_arm_in_mujoco(arm: Xarm7) -> None:
    model = mujoco.MjModel.from_xml_string(urdf())
    data = mujoco.MjData(model)
    data.qpos[:] = [0.3, -0.4, 0.5, 1.2, -0.6, 0.9, 2.0]
    mujoco.mj_kinematics(model, data)
    flange = arm.fk_flange(data.qpos)
    np.testing.assert_allclose(data.body("link7").xpos, flange.position, atol=1e-9)
    np.testing.assert_allclose(data.body("link7").xmat.reshape(3, 3), flange.rotation, atol=1e-9)


@pytest.mark.parametrize(
    ("position", "quaternion", "message"),
    [
        ([0.0, np.nan, 0.0], [0, 0, 0, 1], "position: not finite"),
        ([0.0, 0.0], [0, 0, 0, 1], "position: shape"),
        ([0.0, 0.0, 0.0], [0, 0, 0, 0], "quaternion: all zero"),
        ([0.0, 0.0, 0.0], "abcd", "quaternion: not a list of numbers"),
    ],
)
def test_pose_refuses_what_is_not_one(position: object, quaternion: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Pose(position, quaternion)


def test_pose_matrix_and_quaternion_agree() -> None:
    pose = Pose(np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 2.0, 2.0]))  # normalised: 90 deg
    expected = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(pose.matrix, expected, atol=1e-12)
    back = Pose.from_se3(pose.to_se3())
    np.testing.assert_allclose(back.quaternion, [0, 0, np.sqrt(0.5), np.sqrt(0.5)])
