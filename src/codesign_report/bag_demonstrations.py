"""Recorded trials as demonstrations, whoever was at the controls: a policy or a person.

Observations and actions are those of the messages, at the stamps of the actions; rewards are
computed from the recorded stress as the environment computes them. While a person sends nothing
the arm stands still: such pauses become zero actions, one per control step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from codesign_policy.codesign_env import COMPONENTS, built_design
from codesign_policy.demonstrations import Demonstration, Demonstrations, empty_rows
from codesign_policy.episode import EpisodeLog, Measured, step_components
from codesign_policy.replay import Transitions
from codesign_policy.task import (
    POLICY_PERIOD,
    ControlAction,
    Observation,
    design_stage_observation,
)
from codesign_report.bag_messages import (
    FINISHED,
    BagError,
    Messages,
    policy_window,
    read_messages,
    stamp,
)

TOPICS = ("/object_pose", "/tcp_pose", "/gripper_state", "/stress")
COROTATED = 1  # Stress.msg, what the environment measures
STALE = 200_000_000  # ns, age above which a message says nothing about now
PERIOD_NS = round(POLICY_PERIOD * 1e9)
LANE = np.array([0])

Array = NDArray[np.float64]
Progress = Callable[[float], None]


def import_demonstrations(
    bags: Sequence[Path], progress: Progress = lambda share: None
) -> Demonstrations:
    """Reads trials of one design space.

    Args:
        bags: rosbag2 folders.
        progress: told the share of bags that are done.

    Raises:
        BagError: a bag that cannot be read, a trial that failed, fingers that no design space
            made, stress that was not recorded, actions that are missing.
        ValueError: no bags, or bags of several design spaces.
    """
    shown = []
    for number, bag in enumerate(bags):
        shown.append(_demonstration(Path(bag)))
        progress((number + 1) / len(bags))
    spaces = sorted({each.space for each in shown})
    if len(spaces) != 1:
        raise ValueError(f"bags of the design spaces {spaces}: give bags of one")
    rows = empty_rows(spaces[0], sum(len(each.rows.in_control) for each in shown))
    for bag, each in zip(bags, shown, strict=True):
        try:
            rows.insert(each.rows)
        except ValueError as error:
            raise BagError(f"{bag}: {error}") from error
    return Demonstrations(spaces[0], tuple(each.demonstration for each in shown), rows)


@dataclass(frozen=True)
class _Shown:
    space: str
    demonstration: Demonstration
    rows: Transitions


def _demonstration(bag: Path) -> _Shown:
    messages = read_messages(bag, (*TOPICS, "/action", "/finger_design", "/trial_state"))
    try:
        trial = messages["/trial_state"][-1]
        if trial.state != FINISHED or not trial.metrics.success:
            raise BagError(
                f"{bag}: the trial did not succeed ({trial.message or 'cut off'}): only a grasp "
                "that holds is a demonstration"
            )
        space, design = _design(bag, messages)
        times, actions = _control_steps(bag, messages)
        recorded = _Recorded(bag, messages)
        known = [recorded.complete(time) for time in times]
    except AttributeError as error:
        raise BagError(
            f"{bag}: recorded with other message definitions ({error}): record again"
        ) from error
    first = known.index(True) if any(known) else len(known)
    times, actions = times[first:], actions[first:]
    if len(times) < 3:
        raise BagError(f"{bag}: {len(times)} observed control steps: record the whole trial")
    return _shown(bag, trial.gripper, space, design, times, actions, recorded)


def _shown(
    bag: Path,
    label: str,
    space: str,
    design: Array,
    times: list[int],
    actions: Array,
    recorded: _Recorded,
) -> _Shown:
    observations = np.array([recorded.observation(t, design).normalised() for t in times])
    log = EpisodeLog(1, len(times))
    log.start(LANE, recorded.measured(times[0]))
    components = np.zeros((len(times) - 1, len(COMPONENTS)))
    for step, time in enumerate(times[1:]):
        measured = recorded.measured(time)
        log.add(LANE, measured)
        turned = ControlAction.from_normalised(actions[step]).rotation[None]
        judged = vars(step_components(log, measured, *recorded.tool(time), turned))
        components[step] = [judged[name][0] if name in judged else 0.0 for name in COMPONENTS]
    try:
        metrics = log.metrics(0)
    except ValueError as error:
        raise BagError(f"{bag}: /stress: {error}") from error
    if not metrics.success:
        raise BagError(f"{bag}: the block is not held to the last action: record it for longer")
    described = Demonstration(
        expert=label,
        parameters=tuple(design.astype(np.float32).tolist()),
        width=float(min(recorded.width(time) for time in times)),
        top10_stress=metrics.top10_stress,
        median_stress=metrics.median_stress,
    )
    # The last action is left out: what it led to was not observed.
    return _Shown(space, described, _rows(design, observations, actions[:-1], components))


def _rows(design: Array, observations: Array, actions: Array, components: Array) -> Transitions:
    """The design step, then the control steps; the end of a recording is a time limit."""
    count, steps = len(design), 1 + len(actions)
    seen = np.vstack([design_stage_observation(count), observations]).astype(np.float32)
    both = np.zeros((steps, count + 7), np.float32)
    both[0, :count], both[1:, count:] = design, actions
    last = np.arange(steps) == steps - 1
    return Transitions(
        observation=seen[:-1],
        action=both,
        in_control=np.arange(steps) > 0,
        components=np.vstack([np.zeros((1, len(COMPONENTS))), components]).astype(np.float32),
        next_observation=seen[1:],
        terminated=np.zeros(steps, dtype=bool),
        truncated=last,
    )


def _design(bag: Path, messages: Messages) -> tuple[str, Array]:
    """Design space and parameters of the fingers, which must be those that it makes today."""
    designs = messages["/finger_design"]
    if len({design.content_hash for design in designs}) != 1:
        raise BagError(f"{bag}: the fingers changed during the trial: record one pair per bag")
    fingers = designs[-1]
    parameters = np.array(fingers.parameters, dtype=np.float64)
    if not fingers.cage or not len(parameters):
        raise BagError(
            f"{bag}: fingers {fingers.name!r} have no design parameters: record a trial with "
            "fingers that finger_design made of a cage and parameters"
        )
    try:
        built = built_design(fingers.cage, tuple(parameters.tolist()))
    except ValueError as error:
        raise BagError(f"{bag}: fingers {fingers.name!r}: {error}") from error
    if built.fingers is None or built.fingers.content_hash != fingers.content_hash:
        raise BagError(
            f"{bag}: {fingers.cage} makes other fingers of these parameters now: record again "
            "with this program's fingers"
        )
    return fingers.cage, parameters


def _control_steps(bag: Path, messages: Messages) -> tuple[list[int], Array]:
    """Stamps [ns] of the control steps while the policy ran and their normalised actions (T, 7)."""
    start, stop = policy_window(messages)
    sent = [m for m in messages["/action"] if start <= stamp(m) <= stop]
    numbers = [m.sequence for m in sent]
    if not sent or numbers != list(range(numbers[0], numbers[0] + len(numbers))):
        raise BagError(
            f"{bag}: {len(sent)} actions while the policy ran, their numbers have gaps: "
            "record again"
        )
    times: list[int] = []
    actions: list[Array] = []
    for message in sent:
        while times and stamp(message) - times[-1] > 1.5 * PERIOD_NS:
            times.append(times[-1] + PERIOD_NS)
            actions.append(np.zeros(7))
        times.append(stamp(message))
        actions.append(_normalised(message))
    return times, np.array(actions)


def _normalised(message: Any) -> Array:
    action = ControlAction(_xyz(message.translation), _xyz(message.rotation), message.width)
    return action.normalised()


class _Recorded:
    """What the newest messages at a moment say."""

    def __init__(self, bag: Path, messages: Messages) -> None:
        self._bag = bag
        self._messages: dict[str, list[Any]] = {}
        self._stamps: dict[str, NDArray[np.int64]] = {}
        for topic in TOPICS:
            # A repeated message counts once, and as it was said last.
            latest = {stamp(m): m for m in messages[topic]}
            self._stamps[topic] = np.array(sorted(latest))
            self._messages[topic] = [latest[time] for time in sorted(latest)]
        if any(m.measure != COROTATED for m in messages["/stress"]):
            raise BagError(
                f"{bag}: another measure of stress than the co-rotated one: record again"
            )

    def complete(self, time: int) -> bool:
        """Whether every topic had said something by then, and lately."""
        return all(self._index(topic, time) is not None for topic in TOPICS)

    def _index(self, topic: str, time: int) -> int | None:
        index = int(np.searchsorted(self._stamps[topic], time, side="right")) - 1
        fresh = index >= 0 and time - self._stamps[topic][index] <= STALE
        return index if fresh else None

    def _newest(self, topic: str, time: int) -> Any:
        index = self._index(topic, time)
        if index is None:
            raise BagError(
                f"{self._bag}: nothing on {topic} for {STALE * 1e-9:g} s before "
                f"{time * 1e-9:.3f} s: record again"
            )
        return self._messages[topic][index]

    def observation(self, time: int, design: Array) -> Observation:
        observation = Observation(
            tcp_position=_xyz(self._newest("/tcp_pose", time).pose.position),
            object_position=_xyz(self._newest("/object_pose", time).pose.position),
            width=self.width(time),
            design=design,
        )
        if not observation.is_finite():
            raise BagError(f"{self._bag}: {observation} is not finite: check the estimator")
        return observation

    def width(self, time: int) -> float:
        """The gap [m]."""
        return self._newest("/gripper_state", time).width

    def tool(self, time: int) -> tuple[Array, Array]:
        """Position of the grasp frame and direction of opening, (1, 3) each."""
        pose = self._newest("/tcp_pose", time).pose
        q = pose.orientation
        opening = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([0.0, 1.0, 0.0])
        return _xyz(pose.position)[None], opening[None]

    def measured(self, time: int) -> Measured:
        """As of one lane of the environment; speeds were not recorded."""
        stress = self._newest("/stress", time)
        return Measured(
            centre=_xyz(self._newest("/object_pose", time).pose.position)[None],
            top10_stress=np.array([stress.top10_mean], np.float64),
            mean_stress=np.array([stress.mean], np.float64),
            median_stress=np.array([stress.median], np.float64),
            left_force=_xyz(stress.left_force)[None],
            right_force=_xyz(stress.right_force)[None],
            penetration=np.array([stress.finger_penetration], np.float64),
            object_speed=np.array([np.nan]),
            node_speed=np.array([np.nan]),
        )


def _xyz(message: Any) -> Array:
    return np.array([message.x, message.y, message.z])
