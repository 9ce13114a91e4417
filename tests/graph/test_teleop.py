"""A trial with a person in the place of the policy."""

import json
import subprocess
from pathlib import Path
from typing import Any

import pytest
from codesign_bringup.bringup import Graph, executable, load_profile
from rosbags.highlevel import AnyReader

from codesign_policy.task import MAX_TRANSLATION, MAX_WIDTH_CHANGE
from codesign_report import BagError
from codesign_report.bag_demonstrations import import_demonstrations
from tests.conftest import Probe

RUNNING = 1
HOLD, OPEN, FINISH = 4, 1, 7


def test_a_trial_ends_when_the_person_says_so(probe: Probe, graph: Graph, tmp_path: Path) -> None:
    """Down and open for a second, then finished: recorded like any trial, and no demonstration."""
    from codesign_interfaces.msg import PolicyStatus
    from codesign_nodes import qos
    from sensor_msgs.msg import Joy

    profile = load_profile("teleop")
    settings = {"fem_simulator": {"tetrahedra": 600}, "teleop": {"keyboard": False}}
    for node in profile["nodes"]:
        graph.start(node, profile["parameters"].get(node, {}) | settings.get(node, {}))
    probe.listen("/policy/status", PolicyStatus, qos.EVERY)
    publisher = probe.node.create_publisher(Joy, "/joy", 10)

    def operate() -> None:
        """50 times a second; what the person sees is the status."""
        states = [m for _, m in probe.received["/policy/status"]]
        acts = bool(states) and states[-1].state == RUNNING
        pressed = {HOLD, OPEN} if acts else set()
        if acts and states[-1].sequence > 20:
            pressed.add(FINISH)
        axes = [0.0, 0.0, 0.0, 0.0, -1.0 if acts else 0.0, 0.0, 0.0, 0.0]
        publisher.publish(Joy(axes=axes, buttons=[int(k in pressed) for k in range(8)]))

    timer = probe.node.create_timer(0.02, operate)
    trial = run_trial(tmp_path)
    probe.node.destroy_timer(timer)
    assert trial["message"] == "not lifted and held"
    bag = Path(trial["bag"])
    actions = recorded(bag, "/action")
    assert len(actions) >= 20
    assert [m.sequence for m in actions] == list(range(1, len(actions) + 1))
    for m in actions:
        assert m.translation.z == pytest.approx(-MAX_TRANSLATION[2])
        assert m.width == pytest.approx(0.4 * MAX_WIDTH_CHANGE)
    assert recorded(bag, "/joy")
    tools = [m.pose.position.z for m in recorded(bag, "/tcp_pose")]
    # 0.14 m were asked for; a machine that is too busy for real time may end the motion early.
    assert max(tools) - min(tools) > 0.005
    with pytest.raises(BagError, match=r"the trial did not succeed \(not lifted and held\)"):
        import_demonstrations([bag])


def run_trial(out: Path) -> dict[str, Any]:
    command = [
        str(executable("codesign_bringup", "run_trials")), "--count", "1", "--gripper", "person",
        "--out", str(out), "--timeout", "150",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 1, done.stdout + done.stderr
    (trial,) = json.loads((out / "trials.json").read_text())["trials"]
    return trial


def recorded(bag: Path, topic: str) -> list[Any]:
    with AnyReader([bag]) as reader:
        found = [c for c in reader.connections if c.topic == topic]
        return [reader.deserialize(d, c.msgtype) for c, _, d in reader.messages(found)]
