"""How well a recorded graph kept its rates, from the stamps in its bag."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from codesign_report.bag import BagError

TOPICS = ("/action", "/joint_command", "/joint_states")
PAUSE = 0.5  # s; a longer silence is the time between two trials


@dataclass(frozen=True)
class GraphTiming:
    """Milliseconds, percentiles over one recording.

    Attributes:
        action_to_command: from an action's stamp to that of the first joint command that
            contains it, (A,).
        controller_period: between joint commands, (C,).
        policy_period: between actions, (P,).
        state_period: between joint states, (S,).
        actions_lost: actions that no joint command contains.
    """

    action_to_command: np.ndarray
    controller_period: np.ndarray
    policy_period: np.ndarray
    state_period: np.ndarray
    actions_lost: int


def graph_timing(bag: str | Path) -> GraphTiming:
    """Reads the stamps of a recording made at real time.

    Raises:
        BagError: not a bag, or without actions and joint commands.
    """
    from rosbags.highlevel import AnyReader

    sent: dict[int, int] = {}
    answered: dict[int, int] = {}
    stamps: dict[str, list[int]] = {topic: [] for topic in TOPICS}
    with AnyReader([Path(bag)]) as reader:
        wanted = [c for c in reader.connections if c.topic in TOPICS]
        for connection, _, data in reader.messages(wanted):
            message: Any = reader.deserialize(data, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            stamps[connection.topic].append(stamp)
            if connection.topic == "/action":
                sent[message.sequence] = stamp
            elif connection.topic == "/joint_command" and message.action_sequence:
                answered.setdefault(message.action_sequence, stamp)
    if not sent or not answered:
        raise BagError(f"{bag}: no /action that a /joint_command answers")
    both = sorted(sent.keys() & answered.keys())
    last = max(answered)
    return GraphTiming(
        action_to_command=np.array([(answered[k] - sent[k]) * 1e-6 for k in both]),
        controller_period=_periods(stamps["/joint_command"]),
        policy_period=_periods(stamps["/action"]),
        state_period=_periods(stamps["/joint_states"]),
        actions_lost=sum(k not in answered for k in sent if k <= last),
    )


@dataclass(frozen=True)
class ServoTiming:
    """How far a streaming thread woke up from its deadlines, in milliseconds.

    Attributes:
        p50, p99, max: of the lateness.
        ticks: how many wake-ups that is.
        ticks_missed: deadlines that passed before the thread was ready for them.
        replies_late: servo points whose reply did not come within the wait for it.
        sched_fifo: whether the thread ran under SCHED_FIFO.
        streamed: whether it did so to the end.
    """

    p50: float
    p99: float
    max: float
    ticks: int
    ticks_missed: int
    replies_late: int
    sched_fifo: bool
    streamed: bool


def servo_timing(result: dict[str, Any]) -> ServoTiming:
    """Sums up what `codesign_bringup.servo_bench` wrote.

    Raises:
        ValueError: no wake-up in it.
    """
    lateness = np.array(result["lateness_s"], dtype=float) * 1e3
    if not len(lateness):
        raise ValueError("no wake-ups of the streaming thread were recorded")
    p50, p99 = np.percentile(lateness, [50, 99])
    return ServoTiming(
        p50=float(p50),
        p99=float(p99),
        max=float(lateness.max()),
        ticks=len(lateness),
        ticks_missed=result["ticks_missed"],
        replies_late=result["replies_late"],
        sched_fifo=result["sched_fifo"],
        streamed=result["state"] == "streaming",
    )


def _periods(stamps: list[int]) -> np.ndarray:
    periods = np.diff(np.sort(np.array(stamps))) * 1e-6
    return periods[periods < PAUSE * 1e3]
