"""Recorded trials are replayed: the same policy gives the same actions, bit for bit."""

import json
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from codesign_bringup.bringup import executable
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from codesign_policy.policy_file import TrainedPair
from codesign_policy.shipped import ship
from codesign_policy.task import EPISODE_STEPS
from codesign_report import BagError
from codesign_report.replay import replay
from tests.codesign_policy.random_pair import random_pair

SEED = 3
MEAN = np.array([0.1, -0.1, -0.4, 0.0, 0.0, 0.1, -0.03])


def seeing() -> TrainedPair:
    """For the stock fingers; its actions depend on what it sees."""
    pair = random_pair(np.zeros(0))
    weights = (pair.weights[0], 0.1 * pair.weights[1])
    bias = np.concatenate([np.arctanh(MEAN), np.zeros(7)]).astype(np.float32)
    return replace(pair, weights=weights, biases=(pair.biases[0], bias))


@pytest.fixture(scope="module", params=["lockstep", "real time"])
def bags(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """A trial of the scripted grasp and one of a trained pair, in one graph."""
    out = tmp_path_factory.mktemp("replayed")
    ship(seeing(), out / "seeing")
    command = [
        str(executable("codesign_bringup", "bringup")), "sim", "--quiet",
        *(["--lockstep"] if request.param == "lockstep" else []),
        "--log-folder", str(out / "logs"), "--set", "fem_simulator.tetrahedra=600",
        "--", "run_trials", "--count", "1", "--seed", str(SEED), "--out", str(out),
        "--policy", "scripted", "--policy", str(out / "seeing" / "policy.npz"),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=250)
    assert done.returncode in (0, 1), done.stdout + done.stderr  # the pair picks nothing up
    (out / "seeing" / "policy.npz").unlink()  # the bag is enough
    trials = json.loads((out / "trials.json").read_text())["trials"]
    return {trial["gripper"]: Path(trial["bag"]) for trial in trials}


@pytest.mark.parametrize("name", ["scripted", "seeing"])
def test_every_action_comes_out_again(bags: dict[str, Path], name: str) -> None:
    result = replay(bags[name])
    assert result.first is None
    assert result.identical
    assert result.actions == result.equal > 100
    assert result.unknown == 0
    ((policy, sha256),) = result.policies
    assert (policy == "scripted") == (sha256 == "") == (name == "scripted")


def test_command_line_says_so(bags: dict[str, Path]) -> None:
    command = ["codesign", "bag", "replay", str(bags["seeing"]), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["identical"]
    assert told["actions"] == told["equal"] > 100
    assert told["first_difference"] is None


def altered(bag: Path, out: Path, topic: str, change: Callable[[Any], bool | None]) -> Path:
    """A copy of a bag in which the messages of a topic are changed, or left out for False, or
    stand beside what they were for None."""
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
                changed = change(message)
                if changed is False:
                    continue
                other = store.serialize_cdr(message, connection.msgtype)
                if changed is None:  # said twice, first otherwise
                    writer.write(copies[connection.id], time, other)
                else:
                    data = other
            writer.write(copies[connection.id], time, data)
    return out


def last_bit(message: Any) -> bool:
    """Of one action, as little as can be."""
    if message.sequence == 77:
        message.translation.z = float(np.nextafter(message.translation.z, 1.0))
    return True


@pytest.mark.parametrize("name", ["scripted", "seeing"])
def test_one_changed_bit_is_found(bags: dict[str, Path], name: str, tmp_path: Path) -> None:
    bag = altered(bags[name], tmp_path / "bag", "/action", last_bit)
    result = replay(bag)
    assert not result.identical
    assert result.equal == result.actions - 1
    assert result.first is not None
    assert (result.first.sequence, result.first.component) == (77, "dz")
    assert 0.0 < result.largest < 1e-17
    done = subprocess.run(
        ["codesign", "bag", "replay", str(bag)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1
    assert "action 77, dz" in done.stdout


def test_other_observations_give_other_actions(bags: dict[str, Path], tmp_path: Path) -> None:
    def moved(message: Any) -> bool:
        message.pose.position.x += 1e-4
        return True

    result = replay(altered(bags["seeing"], tmp_path / "bag", "/object_pose", moved))
    assert result.actions - result.equal == EPISODE_STEPS  # what comes after are zeros
    assert result.first is not None
    assert result.first.sequence == 1


@pytest.mark.parametrize("name", ["scripted", "seeing"])
def test_of_two_messages_with_one_stamp_either_may_have_been_seen(
    bags: dict[str, Path], tmp_path: Path, name: str
) -> None:
    def moved(message: Any) -> None:
        message.pose.position.x += 1e-4

    assert replay(altered(bags[name], tmp_path / "bag", "/object_pose", moved)).identical


def other_file(message: Any) -> bool:
    if len(message.file):  # not where the trial before, of the scripted grasp, is told
        message.file = message.file.copy()
        message.file[-1] ^= 1
    return True


def without_settings(message: Any) -> bool:
    message.setting_names, message.setting_values = [], np.zeros(0)
    return True


@pytest.mark.parametrize(
    ("name", "topic", "change", "why"),
    [
        ("scripted", "/action", lambda m: bool(m.sequence != 50), "action 50 of .* is missing"),
        ("scripted", "/action", lambda m: bool(m.sequence > 10), "its first action is number 11"),
        ("scripted", "/policy/setup", lambda m: False, "no messages on /policy/setup: a person"),
        ("scripted", "/policy/setup", without_settings, r"settings \[\] are not those"),
        ("seeing", "/policy/setup", other_file, "the bag is damaged"),
        ("seeing", "/finger_design", lambda m: False, "no messages on /finger_design"),
        ("seeing", "/tcp_pose", lambda m: False, "no messages on /tcp_pose"),
    ],
)
def test_what_does_not_tell_is_refused(
    bags: dict[str, Path], tmp_path: Path, name: str, topic: str, change: Any, why: str
) -> None:
    with pytest.raises(BagError, match=why):
        replay(altered(bags[name], tmp_path / "bag", topic, change))


def test_of_a_cut_recording_the_rest_is_replayed(bags: dict[str, Path], tmp_path: Path) -> None:
    """What one action answers may be written after it: a killed recorder leaves such a tail."""
    whole = replay(bags["scripted"]).actions
    with AnyReader([bags["scripted"]]) as reader:
        stamps = [
            reader.deserialize(d, c.msgtype).header.stamp
            for c, _, d in reader.messages()
            if c.topic == "/tcp_pose"
        ]
    end = stamps[len(stamps) // 2]
    bag = altered(
        bags["scripted"], tmp_path / "bag", "/tcp_pose",
        lambda m: (m.header.stamp.sec, m.header.stamp.nanosec) <= (end.sec, end.nanosec),
    )  # fmt: skip
    result = replay(bag)
    assert result.identical
    assert result.actions + result.unknown == whole
    assert 0.3 * whole < result.actions < 0.7 * whole


def test_a_lost_observation_is_named(bags: dict[str, Path], tmp_path: Path) -> None:
    with AnyReader([bags["scripted"]]) as reader:
        connections = [c for c in reader.connections if c.topic == "/action"]
        actions = [reader.deserialize(d, c.msgtype) for c, _, d in reader.messages(connections)]
    answered = actions[59].gripper_stamp
    bag = altered(
        bags["scripted"], tmp_path / "bag", "/gripper_state",
        lambda m: (m.header.stamp.sec, m.header.stamp.nanosec) != (answered.sec, answered.nanosec),
    )  # fmt: skip
    with pytest.raises(BagError, match=r"action \d+ answers /gripper_state of .* no message"):
        replay(bag)
