"""Bad input to the simulator and the recorder: a clear answer, and nothing is lost."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def simulator(graph: Any, probe: Any) -> Any:
    """A simulator at 600 tetrahedra, and a probe that listens to it."""
    from codesign_interfaces.msg import SoftBodyMesh
    from codesign_nodes import qos
    from sensor_msgs.msg import JointState

    graph.start("fem_simulator", {"tetrahedra": 600})
    probe.listen("/joint_states", JointState, qos.STATE)
    probe.listen("/soft_body_mesh", SoftBodyMesh, qos.LATCHED)
    probe.wait_for(lambda: probe.received["/joint_states"], 60.0, "the simulator runs")
    return probe


def reset(probe: Any, seed: int = 0, **values: float) -> Any:
    from codesign_interfaces.srv import ResetSimulation
    from codesign_nodes.messages import unspecified_domain

    request = ResetSimulation.Request(seed=seed, domain=unspecified_domain())
    for name, value in values.items():
        setattr(request.domain, name, value)
    return probe.call("/fem_simulator/reset", ResetSimulation, request)


def test_reset_draws_what_is_not_asked_for(simulator: Any) -> None:
    first, again = reset(simulator, 5), reset(simulator, 5)
    assert first.success
    assert first.domain == again.domain
    asked = reset(simulator, 5, young_modulus=8500.0)
    assert asked.domain.young_modulus == 8500.0
    assert asked.domain.poisson_ratio == first.domain.poisson_ratio
    assert reset(simulator, 6).domain != first.domain


@pytest.mark.parametrize(
    ("name", "value"),
    [("young_modulus", -9e3), ("poisson_ratio", 0.5), ("density", 0.0), ("friction", -0.1),
     ("x", math.inf)],
)  # fmt: skip
def test_reset_refuses_impossible_material(simulator: Any, name: str, value: float) -> None:
    answer = reset(simulator, **{name: value})
    assert not answer.success
    assert name in answer.message
    assert str(value) in answer.message


def test_commands_that_are_not_finite_do_not_move_the_arm(simulator: Any) -> None:
    from codesign_interfaces.msg import GripperCommand, JointCommand
    from codesign_nodes import qos

    node = simulator.node
    joints = node.create_publisher(JointCommand, "/joint_command", qos.JOINT_COMMAND_OFFERED)
    gripper = node.create_publisher(GripperCommand, "/gripper_command", qos.GRIPPER_COMMAND_OFFERED)
    simulator.wait_for(lambda: joints.get_subscription_count(), 10.0, "discovery")
    before = np.array(simulator.latest("/joint_states").position)
    for _ in range(5):
        joints.publish(JointCommand(position=np.full(7, math.nan)))
        gripper.publish(GripperCommand(width=math.nan))
    count = len(simulator.received["/joint_states"])
    simulator.wait_for(
        lambda: len(simulator.received["/joint_states"]) > count + 20, 10.0, "states go on"
    )
    after = np.array(simulator.latest("/joint_states").position)
    np.testing.assert_array_equal(after, before)


def test_fingers_are_swapped_and_broken_ones_refused(simulator: Any) -> None:
    from codesign_interfaces.msg import FingerDesign, Stress
    from codesign_nodes import messages, qos
    from diagnostic_msgs.msg import DiagnosticArray

    from codesign_design.stock import stock_fingers

    node = simulator.node
    publisher = node.create_publisher(FingerDesign, "/finger_design", qos.LATCHED)
    simulator.listen("/diagnostics", DiagnosticArray, 10)
    simulator.listen("/stress", Stress, qos.STATE)

    def rejections() -> int:
        for _, array in reversed(simulator.received["/diagnostics"]):
            for status in array.status:
                if status.name == "/fem_simulator":
                    return int({v.key: v.value for v in status.values}["designs_refused"])
        return -1

    simulator.wait_for(lambda: rejections() == 0, 10.0, "diagnostics")
    good = messages.design_message(stock_fingers(0.0012))
    publisher.publish(good)
    broken = messages.design_message(stock_fingers(0.0010))
    broken.left.vertices[0].x = math.nan
    publisher.publish(broken)
    simulator.wait_for(lambda: rejections() == 1, 10.0, "the broken finger is refused")
    count = len(simulator.received["/stress"])
    simulator.wait_for(lambda: len(simulator.received["/stress"]) > count + 3, 10.0, "goes on")
    assert math.isfinite(simulator.latest("/stress").top10_mean)


def test_recorder_says_what_it_cannot_do(graph: Any, probe: Any, tmp_path: Path) -> None:
    from codesign_interfaces.srv import StartRecording, StopRecording

    graph.start("trial_recorder")
    idle = probe.call("/trial_recorder/stop", StopRecording, StopRecording.Request())
    assert not idle.success
    assert "not recording" in idle.message

    def start(path: Path | str) -> Any:
        return probe.call(
            "/trial_recorder/start", StartRecording, StartRecording.Request(uri=str(path))
        )

    taken = start(tmp_path)
    assert not taken.success
    assert "exists already" in taken.message
    (tmp_path / "file").write_text("")
    assert not start(tmp_path / "file" / "bag").success
    assert not start("").success

    assert start(tmp_path / "bag").success
    assert start(tmp_path / "bag").success  # asked again, as after a lost answer
    second = start(tmp_path / "other")
    assert not second.success
    assert "already recording" in second.message
    probe.wait_for(lambda: (tmp_path / "bag").exists(), 5.0, "the bag's folder")
    stopped = probe.call("/trial_recorder/stop", StopRecording, StopRecording.Request())
    assert stopped.success, stopped.message
    assert (tmp_path / "bag" / "metadata.yaml").exists()
