"""Made-up trials as demonstrations: known rewards, pauses, and what is refused."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from codesign_policy.codesign_env import COMPONENTS, built_design
from codesign_policy.demonstrations import demonstrations_path, load_demonstrations
from codesign_policy.task import ACTION_SCALE, physical_observations
from codesign_report import bag_demonstrations
from codesign_report.bag_messages import BagError

SPACE = "wide-12"
START = 1_700_000_000_250_000_000  # ns
STEPS = 100  # of 50 ms
PAUSE = range(10, 15)
Messages = dict[str, list[Any]]


def new(**fields: Any) -> SimpleNamespace:
    return SimpleNamespace(**fields)


def xyz(x: float, y: float, z: float) -> SimpleNamespace:
    return new(x=x, y=y, z=z)


def stamp(step: float) -> SimpleNamespace:
    time = START + round(step * 5e7)
    return new(sec=time // 10**9, nanosec=time % 10**9)


def header(step: float) -> SimpleNamespace:
    return new(stamp=stamp(step))


def height(step: int) -> float:
    """On the table to step 40, 0.1 m up from step 60 on [m]."""
    return 0.02 + 0.1 * float(np.clip((step - 40) / 20, 0.0, 1.0))


def messages() -> Messages:
    """A trial with the shipped flat pad: both fingers press with 1 N from step 30 on."""
    pad = load_demonstrations(demonstrations_path(SPACE)).episodes[0]
    pair = built_design(SPACE, pad.parameters).fingers
    assert pair is not None
    down = new(x=1.0, y=0.0, z=0.0, w=0.0)
    found: Messages = {
        "/finger_design": [
            new(
                name="pad",
                cage=SPACE,
                parameters=np.array(pad.parameters),
                content_hash=pair.content_hash,
            )
        ],
        "/trial_state": [
            new(
                header=header(STEPS),
                state=3,
                message="picked up",
                gripper="person",
                metrics=new(success=True),
                started=stamp(0),
                ended=stamp(STEPS),
            )
        ],
        **{topic: [] for topic in (*bag_demonstrations.TOPICS, "/action")},
    }
    for step in range(STEPS + 1):
        pressed = step >= 30
        push = 1.0 if pressed else 0.0
        place = xyz(0.45, 0.01, height(step))
        found["/object_pose"].append(new(header=header(step), pose=new(position=place)))
        tool = new(position=xyz(0.45, 0.01, height(step) + 0.01), orientation=down)
        found["/tcp_pose"].append(new(header=header(step), pose=tool))
        found["/gripper_state"].append(new(header=header(step), width=0.028 if pressed else 0.046))
        # Pointing down, the left finger is on the side of negative y.
        found["/stress"].append(
            new(
                header=header(step),
                measure=1,
                top10_mean=500.0,
                mean=200.0,
                median=150.0,
                left_force=xyz(0.0, push, 0.3 * push),
                right_force=xyz(0.0, -push, 0.3 * push),
                finger_penetration=0.0,
            )
        )
        if step not in PAUSE:
            found["/action"].append(
                new(
                    header=header(step),
                    sequence=len(found["/action"]) + 1,
                    translation=xyz(0.0, 0.0, 0.5 * ACTION_SCALE[2]),
                    rotation=xyz(0.0, 0.0, 0.0),
                    width=-0.25 * ACTION_SCALE[6],
                )
            )
    return found


@pytest.fixture
def bag(monkeypatch: pytest.MonkeyPatch) -> Messages:
    """What is read instead of a bag; tests change it."""
    found = messages()
    monkeypatch.setattr(bag_demonstrations, "read_messages", lambda path, topics: found)
    return found


def imported() -> bag_demonstrations.Demonstrations:
    return bag_demonstrations.import_demonstrations([Path("some")])


def test_rewards_and_description_have_known_values(bag: Messages) -> None:
    shown = imported()
    (episode,) = shown.episodes
    assert (episode.expert, episode.width) == ("person", 0.028)
    assert (episode.top10_stress, episode.median_stress) == (500.0, 150.0)
    (rows,) = shown.transitions()
    assert len(rows.in_control) == 1 + STEPS
    assert rows.truncated.tolist() == [False] * STEPS + [True]
    last = dict(zip(COMPONENTS, rows.components[-1], strict=True))
    assert last["stress"] == pytest.approx(-((0.8 * 500 + 0.2 * 200) ** 2) / 2000)
    assert (last["lift"], last["held"], last["contact"]) == (1.0, 1.0, 1.0)
    assert (last["distance"], last["invalid"]) == (0.0, 0.0)
    assert not rows.components[:29].any()  # nothing touches before step 30
    # Up by 80 mm at step 56, and held from the third such step on.
    held = rows.components[:, COMPONENTS.index("held")]
    assert np.flatnonzero(held)[0] == 58
    seen = physical_observations(rows.observation)[1:]
    np.testing.assert_allclose(seen[:, 5], [height(step) for step in range(STEPS)], atol=1e-6)


def test_pauses_become_zero_actions(bag: Messages) -> None:
    (rows,) = imported().transitions()
    acted = rows.action[1:, -7:]
    for step, action in enumerate(acted):
        expected = [0.0] * 7 if step in PAUSE else [0.0, 0.0, 0.5, 0.0, 0.0, 0.0, -0.25]
        np.testing.assert_allclose(action, expected, atol=1e-7)


def test_steps_before_the_first_observation_are_left_out(bag: Messages) -> None:
    bag["/object_pose"] = bag["/object_pose"][3:]
    (rows,) = imported().transitions()
    assert len(rows.in_control) == 1 + STEPS - 3


def test_what_is_observed_is_what_was_there_at_the_action(bag: Messages) -> None:
    """At real time messages come in between; none from after the action counts."""
    late = bag["/gripper_state"][40]
    late.header, late.width = header(40.2), 0.035
    (rows,) = imported().transitions()
    seen = physical_observations(rows.observation)[1:, 6]
    assert seen[40] == pytest.approx(0.028)
    bag["/action"][35].header = header(40.4)  # the 36th action, of step 40
    (rows,) = imported().transitions()
    assert physical_observations(rows.observation)[1:, 6][40] == pytest.approx(0.035)


def _drop(topic: str, which: slice) -> Callable[[Messages], None]:
    def applied(bag: Messages) -> None:
        del bag[topic][which]

    return applied


def _each(topic: str, **fields: Any) -> Callable[[Messages], None]:
    def applied(bag: Messages) -> None:
        for message in bag[topic]:
            vars(message).update(fields)

    return applied


def _second_pair(bag: Messages) -> None:
    bag["/finger_design"].append(new(**vars(bag["/finger_design"][0]) | {"content_hash": "x"}))


def _lets_go(bag: Messages) -> None:
    for message in bag["/stress"][-15:]:
        message.left_force = message.right_force = xyz(0.0, 0.0, 0.0)


def _too_fast(bag: Messages) -> None:
    bag["/action"][20].translation = xyz(0.0, 0.0, 0.008)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (_each("/trial_state", state=4, message="no word"), r"did not succeed \(no word\)"),
        (_each("/trial_state", metrics=new(success=False)), "did not succeed"),
        (_each("/finger_design", cage=""), "'pad' have no design parameters"),
        (_each("/finger_design", parameters=np.zeros(0)), "'pad' have no design parameters"),
        (_each("/finger_design", cage="box-12"), "box-12 makes other fingers"),
        (_each("/finger_design", cage="cube-8"), "fingers 'pad': .*cube-8"),
        (_each("/finger_design", content_hash="x"), "wide-12 makes other fingers"),
        (_second_pair, "the fingers changed"),
        (_drop("/action", slice(50, 51)), "their numbers have gaps"),
        (_drop("/action", slice(None)), "0 actions"),
        (_drop("/tcp_pose", slice(50, 60)), "nothing on /tcp_pose for 0.2 s"),
        (_drop("/object_pose", slice(0, 99)), "2 observed control steps"),
        (_each("/stress", measure=0), "another measure of stress"),
        (_each("/stress", top10_mean=np.nan), r"/stress: top10_stress\[0\] is nan"),
        (_each("/gripper_state", width=np.nan), "is not finite"),
        (_lets_go, "not held to the last action"),
        (_too_fast, "action reaches 1.14"),
        (lambda bag: delattr(bag["/stress"][0], "measure"), "other message definitions"),
    ],
)
def test_what_is_no_demonstration_is_refused(
    bag: Messages, change: Callable[[Messages], None], why: str
) -> None:
    change(bag)
    with pytest.raises(BagError, match=why):
        imported()


def test_no_bags_are_refused() -> None:
    with pytest.raises(ValueError, match="design spaces"):
        bag_demonstrations.import_demonstrations([])
