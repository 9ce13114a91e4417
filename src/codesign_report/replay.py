"""Replaying a recorded trial: the policy answers the recorded observations once more. Needs no ROS.

Each action names the three messages that it answers by their stamps, and /policy/setup holds what
the policy was made of, so the bag alone is enough.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codesign_policy.policy import Policy, PolicySetup
from codesign_policy.task import ACTION_NAMES, ControlAction, Observation
from codesign_report.bag_messages import BagError, Messages, nanoseconds, read_messages, stamp

ANSWERED = {
    "/object_pose": "observation_stamp",
    "/tcp_pose": "tcp_stamp",
    "/gripper_state": "gripper_stamp",
}
"""Observed topic, and the action's field with the stamp of the message that it answers."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """An action that did not come out again.

    Attributes:
        sequence: number of the action since the policy's start.
        stamp: of the action [ns].
        component: "dx" .. "dw", the first that differs.
        recorded, replayed: its values [m or rad].
    """

    sequence: int
    stamp: int
    component: str
    recorded: float
    replayed: float


@dataclass(frozen=True)
class Replay:
    """Outcome of a replay.

    Attributes:
        policies: name and SHA-256 of the file ("" for the scripted grasp), start by start.
        actions: replayed.
        unknown: further actions at the end of a recording that was cut off before what they answer
            was written.
        equal: of `actions`, those that came out with the same bits.
        largest: largest difference of any component [m or rad]; NaN if one is not finite.
        first: the first that differs.
    """

    policies: tuple[tuple[str, str], ...]
    actions: int
    unknown: int
    equal: int
    largest: float
    first: Difference | None

    @property
    def identical(self) -> bool:
        """Whether there are actions and every one came out with the same bits."""
        return 0 < self.actions == self.equal


def replay(bag: str | Path) -> Replay:
    """Feeds the recorded observations to the recorded policy.

    Raises:
        BagError: not a bag; no action or no word of what the policy was made of; or an action,
            or what one answers, is not in it though what came later is, so that the policy's state
            cannot be known.
    """
    path = Path(bag)
    messages = read_messages(path, ("/action", *ANSWERED, "/finger_design"), ("/policy/setup",))
    if not messages["/policy/setup"]:
        raise BagError(
            f"{path}: no messages on /policy/setup: a person was at the controls, or it is from a "
            "version that did not record what the policy was made of"
        )
    try:
        return _replay(path, messages)
    except AttributeError as error:
        raise BagError(
            f"{path}: recorded with other message definitions ({error}): record again"
        ) from error


def _replay(path: Path, messages: Messages) -> Replay:
    recorded = _Recorded(path, messages)
    policies: list[tuple[str, str]] = []
    actions, equal, largest = 0, 0, 0.0
    first: Difference | None = None
    for run in _runs(path, messages["/action"]):
        setup, policy, design = recorded.policy(run[0])
        policies.append((setup.policy, setup.file_hash))
        for message in run:
            if recorded.ended_before(message):
                break
            actions += 1
            was = _vector(message)
            policy, now = _answer(policy, recorded.observations(message, design), was)
            if was.tobytes() == now.tobytes():
                equal += 1
                continue
            largest = float(np.maximum(largest, np.abs(was - now).max()))
            first = first or _difference(message, was, now)
    unknown = len(messages["/action"]) - actions
    return Replay(tuple(policies), actions, unknown, equal, largest, first)


def _answer(policy: Policy, seen: list[Observation], was: Array) -> tuple[Policy, Array]:
    """The policy after its action, and that action.

    Where several messages with one stamp differ, any of them may have been the one that was seen:
    the first that gives the recorded action counts.
    """
    if len(seen) == 1:
        return policy, _action_vector(policy.act(seen[0]))
    answers = []
    for observation in seen:
        tried = deepcopy(policy)
        answers.append((tried, _action_vector(tried.act(observation))))
        if answers[-1][1].tobytes() == was.tobytes():
            return answers[-1]
    return answers[0]


def _difference(message: Any, was: Array, now: Array) -> Difference:
    k = int(np.argmax(was.view(np.int64) != now.view(np.int64)))
    return Difference(
        int(message.sequence), stamp(message), ACTION_NAMES[k], float(was[k]), float(now[k])
    )


def _runs(path: Path, actions: list[Any]) -> Iterator[list[Any]]:
    """The actions from start to start of the policy, each run complete from its first action on."""
    starts = [k for k, message in enumerate(actions) if message.sequence == 1]
    if starts[:1] != [0]:
        raise BagError(
            f"{path}: its first action is number {actions[0].sequence} of its trial: what the "
            "policy saw before is not known; start recording before the policy"
        )
    for begin, end in zip(starts, [*starts[1:], len(actions)], strict=True):
        run = actions[begin:end]
        for number, message in enumerate(run, start=1):
            if message.sequence != number:
                raise BagError(
                    f"{path}: action {number} of {len(run)} is missing, {message.sequence} comes "
                    "in its place: what the policy saw then is not known"
                )
        yield run


class _Recorded:
    """What a bag says, by stamps."""

    def __init__(self, path: Path, messages: Messages) -> None:
        self._path = path
        self._seen = {topic: _by_stamp(messages[topic]) for topic in ANSWERED}
        self._setups = {stamp(m): m for m in messages["/policy/setup"]}
        self._fingers = {m.content_hash: m for m in messages["/finger_design"]}

    def policy(self, first: Any) -> tuple[PolicySetup, Policy, Array]:
        """The policy that sent an action with number 1, and its fingers' parameters (D,)."""
        message = self._setups.get(stamp(first))
        if message is None:
            raise BagError(
                f"{self._path}: nothing on /policy/setup for the start at "
                f"{stamp(first) * 1e-9:.3f} s: record the whole trial"
            )
        setup = PolicySetup(
            policy=message.policy,
            file=bytes(message.file),
            settings=dict(
                zip(message.setting_names, (float(v) for v in message.setting_values), strict=True)
            ),
        )
        if setup.file_hash != message.file_hash:
            raise BagError(
                f"{self._path}: the policy's file has SHA-256 {setup.file_hash[:12]}, recorded "
                f"was {message.file_hash[:12]}: the bag is damaged"
            )
        fingers = self._fingers.get(message.fingers)
        if fingers is None:
            raise BagError(
                f"{self._path}: the policy used fingers {message.fingers[:12]}, which are not on "
                "/finger_design: record the whole graph"
            )
        try:
            policy = setup.build(fingers)
        except ValueError as error:
            raise BagError(f"{self._path}: {error}") from error
        return setup, policy, np.array(fingers.parameters, np.float64)

    def ended_before(self, action: Any) -> bool:
        """Whether the recording was cut off before something that the action answers came in."""
        return any(
            nanoseconds(getattr(action, field)) > max(self._seen[topic])
            for topic, field in ANSWERED.items()
        )

    def observations(self, action: Any, design: Array) -> list[Observation]:
        """What an action answers: one, unless different messages bear the same stamp."""
        said = [self._answered(action, topic, field) for topic, field in ANSWERED.items()]
        return [
            Observation(
                tcp_position=np.array(tool),
                object_position=np.array(block),
                width=gripper[0],
                design=design,
            )
            for block, tool, gripper in itertools.product(*said)
        ]

    def _answered(self, action: Any, topic: str, field: str) -> list[tuple[float, ...]]:
        time = nanoseconds(getattr(action, field))
        said = self._seen[topic].get(time)
        if said is None:
            raise BagError(
                f"{self._path}: action {action.sequence} answers {topic} of {time * 1e-9:.3f} s, "
                "but no message is stamped so: what the policy saw is not known; record the whole "
                "trial"
            )
        return list(said)


def _by_stamp(messages: list[Any]) -> dict[int, dict[tuple[float, ...], None]]:
    """What was said at each stamp, in the order of recording; a repeated message counts once."""
    said: dict[int, dict[tuple[float, ...], None]] = {}
    for message in messages:
        said.setdefault(stamp(message), {})[_observed(message)] = None
    return said


def _observed(message: Any) -> tuple[float, ...]:
    """What a policy sees of a message: a position, or the gap."""
    if hasattr(message, "width"):
        return (float(message.width),)
    return _xyz(message.pose.position)


def _vector(message: Any) -> Array:
    return np.array([*_xyz(message.translation), *_xyz(message.rotation), message.width])


def _action_vector(action: ControlAction) -> Array:
    return np.array([*action.translation, *action.rotation, action.width], np.float64)


def _xyz(message: Any) -> tuple[float, float, float]:
    return float(message.x), float(message.y), float(message.z)
