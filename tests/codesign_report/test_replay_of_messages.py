"""Replaying made-up messages: what is the same, what is not, and what cannot be known."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from codesign_design.stock import stock_fingers
from codesign_policy.policy import PolicySetup, Surroundings
from codesign_policy.task import Observation
from codesign_report import replay as module
from codesign_report.bag_messages import BagError
from codesign_report.replay import replay

START = 1_700_000_000_000_000_000  # ns
STEPS = 60
FINGERS = stock_fingers()


def new(**fields):
    return SimpleNamespace(**fields)


def time(ns):
    return new(sec=ns // 10**9, nanosec=ns % 10**9)


def header(ns):
    return new(stamp=time(ns))


def xyz(values):
    return new(x=float(values[0]), y=float(values[1]), z=float(values[2]))


def recording():
    """Topics of a run at real time: every observation has a stamp of its own, actions come late."""
    rng = np.random.default_rng(1)
    setup = PolicySetup.of("scripted", Surroundings(0.0, FINGERS))
    policy = setup.build(FINGERS)
    topics = {name: [] for name in ("/action", *module.ANSWERED)}
    for k in range(STEPS):
        moment = START + k * 50_000_000
        stamps = [moment - int(age) for age in rng.integers(1_000_000, 40_000_000, 3)]
        tool, place = [0.45, 0.0, 0.2] + 0.001 * rng.normal(size=(2, 3))
        width = 0.05 + 0.001 * rng.normal()
        observed = zip(module.ANSWERED, stamps, (place, tool, width), strict=True)
        for topic, stamp, value in observed:
            message = new(header=header(stamp))
            if topic == "/gripper_state":
                message.width = value
            else:
                message.pose = new(position=xyz(value))
            topics[topic].append(message)
        action = policy.act(Observation(tool, place, width))
        sent = new(
            header=header(moment),
            sequence=k + 1,
            translation=xyz(action.translation),
            rotation=xyz(action.rotation),
            width=action.width,
        )
        for (_, field), stamp in zip(module.ANSWERED.items(), stamps, strict=True):
            setattr(sent, field, time(stamp))
        topics["/action"].append(sent)
    told = new(
        header=header(START), policy="scripted", file=[], file_hash="", fingers="own",
        setting_names=list(setup.settings), setting_values=list(setup.settings.values()),
    )  # fmt: skip
    fingers = new(content_hash="own", name="stock", cage="", parameters=np.zeros(0))
    return topics | {"/policy/setup": [told], "/finger_design": [fingers]}


@pytest.fixture
def bag(monkeypatch):
    messages = recording()
    monkeypatch.setattr(module, "read_messages", lambda *_: messages)
    return messages


def test_every_action_comes_out_again(bag):
    result = replay(Path("bag"))
    assert (result.actions, result.equal, result.unknown) == (STEPS, STEPS, 0)
    assert result.identical
    assert result.largest == 0.0
    assert result.policies == (("scripted", ""),)


def test_a_changed_bit_is_found(bag):
    sent = bag["/action"][17]
    sent.width = float(np.nextafter(sent.width, 1.0))
    result = replay(Path("bag"))
    assert not result.identical
    assert result.equal == STEPS - 1
    assert (result.first.sequence, result.first.component) == (18, "dw")
    assert result.first.recorded == sent.width != result.first.replayed


def test_the_sign_of_zero_is_a_bit(bag):
    bag["/action"][3].rotation.y = -0.0
    assert (replay(Path("bag")).first.sequence, replay(Path("bag")).first.component) == (4, "ry")


def test_a_value_that_is_not_finite_is_a_difference(bag):
    bag["/action"][3].translation.x = float("nan")
    result = replay(Path("bag"))
    assert result.equal == STEPS - 1
    assert np.isnan(result.largest)


def test_another_observation_or_setting_is_found(bag):
    bag["/object_pose"][0].pose.position.x += 1e-6
    result = replay(Path("bag"))
    assert not result.identical
    assert (result.first.sequence, result.first.component) == (1, "dx")
    bag["/object_pose"][0].pose.position.x -= 1e-6
    setup = bag["/policy/setup"][0]
    setup.setting_values[setup.setting_names.index("open_width")] += 1e-6
    assert not replay(Path("bag")).identical


def test_order_and_repetition_of_observations_do_not_matter(bag):
    for topic in module.ANSWERED:
        bag[topic] = bag[topic][::-1] + bag[topic][:5]
    assert replay(Path("bag")).identical


def test_of_two_messages_with_one_stamp_either_may_have_been_seen(bag):
    for message in list(bag["/tcp_pose"]):
        position = message.pose.position
        other = xyz([position.x + 1e-3, position.y, position.z])
        bag["/tcp_pose"].insert(0, new(header=message.header, pose=new(position=other)))
    assert replay(Path("bag")).identical
    bag["/action"][30].width += 1e-6
    assert replay(Path("bag")).equal == STEPS - 1


def test_several_starts_are_replayed_each_from_its_own(bag):
    again = recording()
    shift = 100_000_000_000
    for messages in again.values():
        for message in messages:
            for name, value in vars(message).items():
                stamp = value.stamp if name == "header" else value
                if hasattr(stamp, "nanosec"):
                    stamp.sec += shift // 10**9
    for topic in bag:
        bag[topic] = bag[topic] + again[topic]
    result = replay(Path("bag"))
    assert result.identical
    assert (result.actions, len(result.policies)) == (2 * STEPS, 2)


def test_a_tail_that_was_cut_off_is_counted(bag):
    bag["/gripper_state"] = bag["/gripper_state"][:40]
    result = replay(Path("bag"))
    assert result.identical
    assert (result.actions, result.unknown) == (40, STEPS - 40)


@pytest.mark.parametrize(
    ("topic", "lost", "why"),
    [
        ("/action", slice(0, 4), "its first action is number 5"),
        ("/action", slice(20, 21), "action 21 of 59 is missing, 22 comes in its place"),
        ("/object_pose", slice(20, 21), "action 21 answers /object_pose of .* no message"),
        ("/policy/setup", slice(0, 1), "no messages on /policy/setup"),
        ("/finger_design", slice(0, 1), "used fingers own, which are not on /finger_design"),
    ],
)
def test_what_cannot_be_known_is_refused(bag, topic, lost, why):
    del bag[topic][lost]
    with pytest.raises(BagError, match=why):
        replay(Path("bag"))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"header": header(START + 1)}, "nothing on /policy/setup for the start at"),
        ({"file": b"x"}, "the bag is damaged"),
        ({"setting_names": ["x"], "setting_values": [1.0]}, "are not those of this program"),
    ],
)
def test_a_setup_that_does_not_fit_is_refused(bag, change, why):
    vars(bag["/policy/setup"][0]).update(change)
    with pytest.raises(BagError, match=why):
        replay(Path("bag"))


def test_other_message_definitions_are_named(bag):
    del bag["/action"][0].tcp_stamp
    with pytest.raises(BagError, match="other message definitions"):
        replay(Path("bag"))
