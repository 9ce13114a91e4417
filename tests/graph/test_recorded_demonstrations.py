"""A trial over the graph as a demonstration: what was recorded is what is learned from."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from codesign_bringup.bringup import Graph, executable, load_profile
from gymnasium.vector import VectorEnv
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from codesign_policy.codesign_env import COMPONENTS, CodesignEnv
from codesign_policy.control_env import ControlConfig
from codesign_policy.demonstrations import (
    Demonstrations,
    demonstrations_path,
    load_demonstrations,
)
from codesign_policy.task import ControlAction, Observation
from codesign_report import BagError
from codesign_report.bag_demonstrations import import_demonstrations
from tests.conftest import LOG_FOLDER, Probe

SEED = 3
SPACE = "wide-12"


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("logs")


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory, logs: Path) -> Path:
    """A lockstep trial of the scripted grasp with the shipped flat pad."""
    from codesign_interfaces.srv import GenerateDesign

    folder = tmp_path_factory.mktemp("shown")
    profile = load_profile("sim")
    settings = {
        "fem_simulator": {"tetrahedra": 600},
        "finger_design": {"output_dir": str(folder / "files")},
    }
    pad = load_demonstrations(demonstrations_path(SPACE)).episodes[0]
    order = GenerateDesign.Request(name="pad", cage=SPACE, parameters=list(pad.parameters))
    with Graph(logs, quiet=True) as graph:
        for node in profile["nodes"]:
            parameters = profile["parameters"].get(node, {}) | settings.get(node, {})
            graph.start(node, parameters, lockstep=True)
        probe = Probe()
        try:
            answer = probe.call("/finger_design/generate_design", GenerateDesign, order, 150.0)
            assert answer.success, answer.message
            return trial(folder, "pad")
        finally:
            probe.close()


def trial(folder: Path, label: str) -> Path:
    command = [
        str(executable("codesign_bringup", "run_trials")), "--count", "1", "--seed", str(SEED),
        "--gripper", label, "--out", str(folder / label), "--timeout", "200",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout + done.stderr
    (result,) = json.loads((folder / label / "trials.json").read_text())["trials"]
    return Path(result["bag"])


@pytest.fixture(autouse=True)
def shown_logs(request: pytest.FixtureRequest, logs: Path) -> None:
    request.node.stash[LOG_FOLDER] = logs


@pytest.fixture
def shown(bag: Path) -> Demonstrations:
    return import_demonstrations([bag])


def recorded(bag: Path, topic: str) -> dict[int, Any]:
    """Messages by their stamp [ns]."""
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        found = [reader.deserialize(d, c.msgtype) for c, _, d in reader.messages(connections)]
    return {m.header.stamp.sec * 10**9 + m.header.stamp.nanosec: m for m in found}


def xyz(message: Any) -> list[float]:
    return [message.x, message.y, message.z]


def test_every_row_is_what_the_messages_say(
    bag: Path, shown: Demonstrations, tmp_path: Path
) -> None:
    sent = recorded(bag, "/action")
    poses, tools = recorded(bag, "/object_pose"), recorded(bag, "/tcp_pose")
    grippers = recorded(bag, "/gripper_state")
    (rows,) = shown.transitions()
    parameters = np.array(shown.episodes[0].parameters)
    observed = sorted(sent.keys() & poses.keys() & tools.keys() & grippers.keys())
    # Policies go on after they are done, and the last action has no observed result.
    steps = observed[: len(rows.in_control) - 1]
    assert len(observed) - len(steps) < 20
    for row, time in enumerate(steps, start=1):
        action = ControlAction(
            np.array(xyz(sent[time].translation)),
            np.array(xyz(sent[time].rotation)),
            sent[time].width,
        )
        np.testing.assert_array_equal(
            rows.action[row, len(parameters) :], action.normalised().astype(np.float32)
        )
        observation = Observation(
            np.array(xyz(tools[time].pose.position)),
            np.array(xyz(poses[time].pose.position)),
            grippers[time].width,
            parameters,
        )
        np.testing.assert_array_equal(
            rows.observation[row], observation.normalised().astype(np.float32)
        )
    shown.save(tmp_path / "shown", "recorded-v0")
    loaded = load_demonstrations(tmp_path / "shown")
    assert loaded.episodes == shown.episodes
    assert loaded.episodes[0].expert == "pad"


def test_the_environment_gives_the_same_rewards_for_these_actions(shown: Demonstrations) -> None:
    """Simulated again without the graph: the environment's lag stands in for arm and servo."""
    (rows,) = shown.transitions()
    config = ControlConfig(tetrahedra=600)
    env: VectorEnv = CodesignEnv(SPACE, 4, config=config)
    designs = np.tile(shown.designs, (4, 1))
    env.reset(seed=SEED, options={"designs": designs})
    again = []
    for action in rows.action[1:, -7:]:
        *_, info = env.step(np.tile(action, (4, 1)))
        again.append([info[f"reward_{name}"][0] for name in COMPONENTS])
    env.close()
    ours, theirs = rows.components[1:].sum(axis=0), np.sum(again, axis=0)
    # Sums of shares and Pa; of steps held, one or two; of metres times steps.
    tolerances = {"lift": 0.5, "held": 2.0, "contact": 1.0, "stress": 100.0, "distance": 0.01}
    for name, tolerance in tolerances.items():
        k = COMPONENTS.index(name)
        assert ours[k] == pytest.approx(theirs[k], abs=tolerance), name
    assert ours[COMPONENTS.index("stress")] < -5000.0


def test_trials_that_show_nothing_are_refused(bag: Path, tmp_path: Path) -> None:
    stock = altered(bag, tmp_path / "stock", "/finger_design", without_parameters)
    with pytest.raises(BagError, match="fingers 'pad' have no design parameters"):
        import_demonstrations([stock])
    failed = altered(bag, tmp_path / "failed", "/trial_state", fail)
    with pytest.raises(BagError, match="the trial did not succeed"):
        import_demonstrations([failed])
    other = altered(bag, tmp_path / "other", "/finger_design", with_other_parameters)
    with pytest.raises(BagError, match="wide-12 makes other fingers of these parameters now"):
        import_demonstrations([other])
    lost = altered(bag, tmp_path / "lost", "/action", lambda m: m.sequence != 50)
    with pytest.raises(BagError, match="their numbers have gaps"):
        import_demonstrations([lost])
    silent = altered(bag, tmp_path / "silent", "/stress", lambda m: False)
    with pytest.raises(BagError, match="no messages on /stress"):
        import_demonstrations([silent])


def fail(message: Any) -> bool:
    message.metrics.success = False
    return True


def without_parameters(message: Any) -> bool:
    message.cage, message.parameters = "", message.parameters[:0]
    return True


def with_other_parameters(message: Any) -> bool:
    message.parameters = message.parameters + 0.01
    return True


def altered(bag: Path, out: Path, topic: str, change: Any) -> Path:
    """A copy of a bag in which the messages of a topic are changed, or left out for False."""
    with (
        AnyReader([bag]) as reader,
        Writer(out, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        store = reader.typestore
        copies = {
            c.id: writer.add_connection(
                c.topic, c.msgtype, typestore=store, offered_qos_profiles=c.ext.offered_qos_profiles
            )
            for c in reader.connections
        }
        for connection, time, data in reader.messages():
            if connection.topic == topic:
                message = reader.deserialize(data, connection.msgtype)
                if not change(message):
                    continue
                data = store.serialize_cdr(message, connection.msgtype)
            writer.write(copies[connection.id], time, data)
    return out


def test_the_bag_goes_on_working_without_the_graph(bag: Path, tmp_path: Path) -> None:
    """On the command line, as somebody would who was sent two bags."""
    second = shutil.copytree(bag, tmp_path / "second")
    command = ["codesign", "policy", "import-demonstrations", str(bag), str(second)]
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "shown"), "--json"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["space"] == SPACE
    assert len(load_demonstrations(tmp_path / "shown").episodes) == 2
