"""xarm_driver in the place of fem_simulator: real SDK, fake control box, real DDS."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from codesign_control import Xarm7
from codesign_control.grasp_frame import start_posture
from codesign_control.gripper import GripperModel
from tests.fake_box import FakeBox
from tests.fake_box.gripper import g2_pulses

READY, MOVING = 1, 2


class Cell:
    """A box, the driver, the controller, and someone who looks on."""

    def __init__(self, box: FakeBox, probe: Any, graph: Any, **parameters: Any) -> None:
        from codesign_interfaces.msg import ControllerStatus, GripperState, JointCommand
        from codesign_nodes import qos
        from diagnostic_msgs.msg import DiagnosticArray
        from sensor_msgs.msg import JointState

        self.box, self.probe = box, probe
        for topic, kind, profile in (
            ("/joint_states", JointState, qos.EVERY),
            ("/gripper_state", GripperState, qos.EVERY),
            ("/joint_command", JointCommand, qos.EVERY),
            ("/diagnostics", DiagnosticArray, qos.EVERY),
            ("/cartesian_controller/status", ControllerStatus, qos.EVERY),
        ):
            probe.listen(topic, kind, profile)
        self.driver = graph.start(
            "xarm_driver",
            {"address": box.address} | parameters,
            realtime=True,
        )
        self.controller = graph.start("cartesian_controller", realtime=True)
        probe.wait_for(lambda: probe.received["/gripper_state"], 20.0, "the gripper's state")
        probe.wait_for(lambda: len(probe.received["/joint_states"]) > 20, 20.0, "joint states")

    def trigger(self, name: str) -> Any:
        from std_srvs.srv import Trigger

        return self.probe.call(name, Trigger, Trigger.Request())

    def enable(self, node: str, on: bool = True) -> Any:
        from std_srvs.srv import SetBool

        return self.probe.call(f"/{node}/enable", SetBool, SetBool.Request(data=on))

    def diagnosis(self) -> dict[str, str]:
        for _, array in reversed(self.probe.received["/diagnostics"]):
            status = array.status[0]
            if status.name == "/xarm_driver":
                return {"message": status.message} | {v.key: v.value for v in status.values}
        return {}

    def wait_for_state(self, state: str, timeout: float = 5.0) -> None:
        self.probe.wait_for(
            lambda: self.diagnosis().get("state") == state, timeout, f"driver {state}"
        )

    def enable_both(self) -> None:
        answer = self.enable("xarm_driver")
        assert answer.success, answer.message
        answer = self.enable("cartesian_controller")
        assert answer.success, answer.message
        self.wait_for_state("streaming")

    def move(self, joints: np.ndarray, width: float = math.nan, speed: float = 0.5) -> None:
        from codesign_interfaces.action import MoveTo
        from rclpy.action import ActionClient

        client = ActionClient(self.probe.node, MoveTo, "/cartesian_controller/move_to")
        assert client.wait_for_server(10.0)
        goal = MoveTo.Goal(joints=joints.tolist(), width=width, speed_scale=speed)
        sent = self.probe.run(lambda: client.send_goal_async(goal))
        self.probe.wait_for(sent.done, 10.0, "goal taken")
        result = self.probe.run(sent.result().get_result_async)
        self.probe.wait_for(result.done, 20.0, "goal ended")
        status = self.probe.latest("/cartesian_controller/status")
        answer = result.result().result
        assert answer.success, f"{answer.message}: {status.message}; driver: {self.diagnosis()}"


@pytest.fixture
def start() -> np.ndarray:
    return start_posture(Xarm7(), GripperModel(), 0.06)


@pytest.fixture
def box(start: np.ndarray) -> Iterator[FakeBox]:
    with FakeBox(joints=start.tolist()) as box:
        yield box


@pytest.mark.parametrize("gripper", ["g1", "g2"])
def test_the_controller_moves_arm_and_gripper(
    box: FakeBox, probe: Any, graph: Any, start: np.ndarray, gripper: str
) -> None:
    cell = Cell(box, probe, graph, gripper=gripper)
    assert not box.commands("servo_j", "motion_enable", "set_mode")  # before anybody asks
    cell.enable_both()
    goal = np.add(start, [0.2, 0.1, 0.0, 0.1, 0.0, 0.0, -0.3])
    cell.move(goal, width=0.03)
    probe.wait_for(
        lambda: np.abs(np.array(box.switch()["joints"]) - goal).max() < 2e-3, 3.0, "the arm arrives"
    )
    probe.wait_for(
        lambda: abs(probe.latest("/gripper_state").width - 0.03) < 3e-4, 5.0, "the gripper arrives"
    )
    probe.wait_for(
        lambda: np.abs(np.array(probe.latest("/joint_states").position) - goal).max() < 2e-3,
        5.0,
        "the arrival is reported",
    )
    assert not box.violations()
    assert cell.diagnosis()["message"] == "streaming: streaming"
    # Told once a second: the arm may have arrived before.
    probe.wait_for(lambda: int(cell.diagnosis()["points_sent"]) > 50, 3.0, "the points are told")


def test_states_come_at_the_arms_rate(box: FakeBox, probe: Any, graph: Any) -> None:
    Cell(box, probe, graph)
    received = probe.received["/joint_states"]
    before = len(received)
    probe.poll(lambda: False, 2.0)
    moments = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for _, m in received[before:]]
    assert len(moments) == pytest.approx(200, rel=0.1)
    assert np.median(np.diff(moments)) == pytest.approx(0.01, rel=0.1)


def test_recovery_by_the_service_without_a_restart(
    box: FakeBox, probe: Any, graph: Any, start: np.ndarray
) -> None:
    cell = Cell(box, probe, graph)
    cell.enable_both()
    box.switch(error=31)
    cell.wait_for_state("fault")
    probe.wait_for(lambda: cell.diagnosis()["error"] == "31", 3.0, "C31 in the diagnostics")
    answer = cell.enable("xarm_driver")
    assert not answer.success
    assert "C31" in answer.message
    answer = cell.trigger("/xarm_driver/recover")
    assert answer.success, answer.message
    # The controller held its posture meanwhile, which is still the arm's.
    cell.wait_for_state("streaming")
    cell.move(np.add(start, [0.1, 0, 0, 0, 0, 0, 0]))
    assert not box.violations()


def test_a_dry_run_reads_and_sends_nothing_that_moves(box: FakeBox, probe: Any, graph: Any) -> None:
    cell = Cell(box, probe, graph, dry_run=True)
    for answer in (cell.enable("xarm_driver"), cell.trigger("/xarm_driver/recover")):
        assert not answer.success
        assert "dry run" in answer.message
    assert cell.enable("cartesian_controller").success  # its commands come to nothing
    count = len(probe.received["/joint_command"])
    probe.wait_for(lambda: len(probe.received["/joint_command"]) > count + 50, 5.0, "commands")
    moving = ("servo_j", "motion_enable", "set_mode", "set_state", "clean_error", "write_tool")
    assert not box.commands(*moving)
    assert all(r["gripper"] == "read" for r in box.commands("gripper"))
    assert len(probe.received["/joint_states"]) > 50


class BlockOnTheTable:
    """Stands in for the camera: a block that lies still, 20 times a second."""

    def __init__(self, probe: Any, position: tuple[float, float, float]) -> None:
        from codesign_nodes import messages, qos
        from geometry_msgs.msg import PoseStamped

        publisher = probe.node.create_publisher(PoseStamped, "/object_pose", qos.POSE_OFFERED)

        def publish() -> None:
            pose = PoseStamped(pose=messages.pose(position, (0.0, 0.0, 0.0, 1.0)))
            pose.header.stamp = probe.node.get_clock().now().to_msg()
            pose.header.frame_id = "link_base"
            publisher.publish(pose)

        self._timer = probe.node.create_timer(0.05, publish)


def test_the_scripted_policy_grasps_and_lifts_with_the_fake_arm(
    box: FakeBox, probe: Any, graph: Any
) -> None:
    from codesign_interfaces.msg import PolicyStatus
    from codesign_nodes import qos
    from std_srvs.srv import Trigger

    cell = Cell(box, probe, graph)
    graph.start("finger_design")
    graph.start("policy", {"orders_fingers": False}, realtime=True)
    probe.listen("/policy/status", PolicyStatus, qos.EVERY)
    block = BlockOnTheTable(probe, (0.45, 0.02, 0.02))
    assert block
    cell.enable_both()
    cell.probe.wait_for(
        lambda: probe.call("/policy/start", Trigger, Trigger.Request()).success, 60.0, "the policy"
    )

    arm = Xarm7()

    def path() -> np.ndarray:
        """Where the points on the wire have taken the TCP, (n, 3) [m]."""
        points = box.servo_points()[1][::10]
        return np.array([arm.fk_tcp(q).position for q in points]).reshape(-1, 3)

    def lifted() -> bool:
        heights = path()[:, 2]
        return len(heights) > 0 and heights[-1] > heights.min() + 0.095

    done = probe.poll(lambda: probe.poll(lambda: False, 0.5) or lifted(), 60.0)
    assert done, (probe.latest("/policy/status").message, cell.diagnosis())
    way = path()
    lowest = way[np.argmin(way[:, 2])]
    # Over the block, which stands off the middle, and down to it.
    np.testing.assert_allclose(lowest[:2], [0.45, 0.02], atol=0.005)
    assert 0.0 < lowest[2] < 0.04
    closed = box.switch()["gripper_position"]
    assert closed < g2_pulses(28.5)  # on a block of 30 mm
    assert cell.diagnosis()["pauses"] == "0"
    assert not box.violations()


def test_a_driver_that_is_killed_and_started_again(
    box: FakeBox, probe: Any, graph: Any, start: np.ndarray
) -> None:
    """The controller calls it a fault; after its reset, everything wants enabling once more."""
    import time

    cell = Cell(box, probe, graph)
    cell.enable_both()
    cell.driver.process.kill()
    fault = 4
    probe.wait_for(
        lambda: probe.latest("/cartesian_controller/status").state == fault, 5.0, "a fault"
    )
    count = len(probe.received["/joint_states"])
    graph.start("xarm_driver", {"address": box.address}, realtime=True)
    probe.wait_for(lambda: len(probe.received["/joint_states"]) > count, 20.0, "states again")
    connected = [r["t"] for r in box.records() if r.get("event") == "connected"][-1]
    assert probe.received["/joint_states"][count][0] - connected < 2.0
    commands = box.commands("servo_j")
    time.sleep(0.3)
    assert box.commands("servo_j") == commands
    answer = cell.trigger("/cartesian_controller/reset_fault")
    assert answer.success, answer.message
    cell.enable_both()
    cell.move(np.add(start, [0.1, 0, 0, 0, 0, 0, 0]))
    assert not box.violations()


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        ({"gripper": "g3"}, "expected one of g1, g2, none"),
        ({"rate": 300}, "rate"),
        ({"command_timeout": 5.0}, "command_timeout"),
        ({"use_sim_time": True}, "no simulated time"),
    ],
)
def test_a_bad_parameter_is_refused(
    graph: Any, parameters: dict[str, Any], said: str, tmp_path: Any
) -> None:
    child = graph.start("xarm_driver", parameters)
    assert child.process.wait(20.0) == 1
    assert said in (tmp_path / "logs" / "xarm_driver.log").read_text()
