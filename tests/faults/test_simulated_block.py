"""A simulated block under a real arm: what the simulator does when the arm's driver fails it."""

import math
import subprocess
import time
from typing import Any

import numpy as np
import pytest
from codesign_bringup.bringup import executable

from codesign_control import Pose, Xarm7
from codesign_control.grasp_frame import start_posture
from codesign_control.gripper import GripperModel

WIDTH = 0.06  # m, as the stand-in reports


@pytest.fixture
def block(graph: Any, probe: Any, arm: Any) -> Any:
    """The simulator under the stand-in's arm, and a probe that listens to it."""
    from codesign_interfaces.msg import SimulationState
    from codesign_nodes import qos
    from diagnostic_msgs.msg import DiagnosticArray

    probe.listen("/simulation_state", SimulationState, qos.EVERY)
    probe.listen("/diagnostics", DiagnosticArray, 100)
    graph.start(
        "fem_simulator",
        {"tetrahedra": 600, "follow_arm": True, "publish_design": False,
         "object_pose_topic": "/ground_truth/object_pose"},
    )  # fmt: skip
    probe.wait_for(lambda: probe.received["/simulation_state"], 60.0, "a block is put down")
    return probe


def said(probe: Any) -> str:
    """The simulator's newest word on /diagnostics."""
    found = [
        status.message
        for _, array in probe.received["/diagnostics"]
        for status in array.status
        if status.name == "/fem_simulator"
    ]
    return found[-1] if found else ""


def finger_at(probe: Any) -> np.ndarray:
    p = probe.latest("/simulation_state").left_finger.position
    return np.array([p.x, p.y, p.z])


def reaching(x: float, y: float, z: float) -> np.ndarray:
    """Joints (7,) [rad] that hold the grasp frame there [m], fingers down."""
    xarm, gripper = Xarm7(), GripperModel()
    home = start_posture(xarm, gripper, WIDTH)
    down = np.array([x, y, z + gripper.finger_z(WIDTH)])
    return xarm.ik(Pose(down, xarm.fk_tcp(home).quaternion), home)


def reset(probe: Any) -> Any:
    from codesign_interfaces.srv import ResetSimulation
    from codesign_nodes.messages import unspecified_domain

    request = ResetSimulation.Request(seed=1, domain=unspecified_domain())
    return probe.call("/fem_simulator/reset", ResetSimulation, request)


def test_the_fingers_go_with_the_arm_and_nobody_publishes_a_second_one(
    block: Any, arm: Any
) -> None:
    before = finger_at(block)
    arm.joints = arm.joints + 0.02 * np.eye(7)[0]
    moved = 0.02 * 0.45
    block.wait_for(
        lambda: finger_at(block)[1] - before[1] == pytest.approx(moved, rel=0.1), 5.0, "they follow"
    )
    assert block.node.count_publishers("/joint_states") == 1
    assert block.node.count_publishers("/gripper_state") == 1


@pytest.mark.parametrize("fault", ["silent", "not finite"])
def test_without_the_arms_reports_the_fingers_stand_still(block: Any, arm: Any, fault: str) -> None:
    good = arm.joints
    if fault == "silent":
        arm.sends_states = False
    else:
        arm.joints = np.full(7, math.nan)
    block.wait_for(
        lambda: said(block).startswith("the fingers stand still: no /joint_states"), 10.0, "told"
    )
    stood, count = finger_at(block), len(block.received["/simulation_state"])
    arm.joints = good + 0.02 * np.eye(7)[0] if fault == "silent" else arm.joints
    time.sleep(1.0)
    assert len(block.received["/simulation_state"]) > count + 5  # the block goes on
    np.testing.assert_array_equal(finger_at(block), stood)
    arm.joints, arm.sends_states = good, True
    block.wait_for(lambda: said(block) == "running", 10.0, "well again")


def test_a_reset_under_fingers_that_are_in_the_way_is_refused(block: Any, arm: Any) -> None:
    stood = reset(block)
    assert stood.success, stood.message
    arm.joints = reaching(0.45, 0.03, 0.02)
    block.wait_for(lambda: finger_at(block)[2] < 0.05, 10.0, "the fingers are down")
    time.sleep(0.5)
    before = block.latest("/simulation_state").positions
    refused = reset(block)
    assert not refused.success
    assert "the fingers are where the block is to stand" in refused.message
    assert "move the arm away" in refused.message
    assert np.abs(np.subtract(block.latest("/simulation_state").positions, before)).max() < 0.002
    arm.joints = reaching(0.45, 0.0, 0.25)
    block.wait_for(lambda: finger_at(block)[2] > 0.2, 10.0, "the fingers are up")
    assert reset(block).success
    arm.sends_states = False
    time.sleep(0.5)
    refused = reset(block)
    assert not refused.success
    assert "where the fingers are is not known" in refused.message


def test_simulated_time_is_refused() -> None:
    command = [str(executable("codesign_nodes", "fem_simulator")), "--ros-args"]
    command += ["-p", "follow_arm:=true", "-p", "use_sim_time:=true"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert "follow_arm: a real arm has no simulated time" in done.stderr
