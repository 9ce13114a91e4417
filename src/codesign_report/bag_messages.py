"""The messages of a trial bag: a rosbag2 folder (MCAP). Needs no ROS.

Message definitions are taken from the bag itself, times from each message's header.stamp.
"""

from collections import defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any

RUNNING, FINISHED = 2, 3  # TrialState.msg

Messages = dict[str, list[Any]]


class BagError(ValueError):
    """The bag can't be used; the message names it, what is wrong and what to do."""


def read_messages(
    path: Path, required: Collection[str], optional: Collection[str] = ()
) -> Messages:
    """The messages of these topics, each topic's in the order of recording.

    Args:
        path: rosbag2 folder, or an .mcap file (what a killed recorder leaves).
        required: topics without which the bag is of no use.
        optional: topics that may be missing.

    Raises:
        BagError: not a bag, truncated, or a required topic is missing or empty.
    """
    from rosbags.highlevel import AnyReader

    source = _source(path)
    messages: Messages = defaultdict(list)
    try:
        with AnyReader([source]) as reader:
            missing = sorted(set(required) - {c.topic for c in reader.connections if c.msgcount})
            if missing:
                raise BagError(
                    f"{path}: no messages on {', '.join(missing)}: record the whole graph"
                )
            wanted = [c for c in reader.connections if c.topic in (*required, *optional)]
            for connection, _, data in reader.messages(wanted):
                messages[connection.topic].append(reader.deserialize(data, connection.msgtype))
    except BagError:
        raise
    except Exception as error:  # the reader raises many kinds for damaged files
        raise _unreadable(path, error) from error
    return messages


def recorded_topics(path: Path) -> set[str]:
    """Topics with messages.

    Raises:
        BagError: not a bag, or truncated.
    """
    from rosbags.highlevel import AnyReader

    source = _source(path)
    try:
        with AnyReader([source]) as reader:
            return {c.topic for c in reader.connections if c.msgcount}
    except Exception as error:  # the reader raises many kinds for damaged files
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> BagError:
    return BagError(
        f"{path}: cannot be read ({error}): if the recorder was killed or its disk was full, "
        "save what is there with `codesign bag recover`"
    )


def _source(path: Path) -> Path:
    """What to open: the folder, or the single .mcap of a folder that lost its metadata."""
    if not path.exists():
        raise BagError(f"{path}: does not exist: give a rosbag2 folder")
    if path.is_file():
        if path.suffix != ".mcap":
            raise BagError(f"{path}: not a bag: give a rosbag2 folder or an .mcap file")
        return path
    if (path / "metadata.yaml").exists():
        return path
    return mcap_file(path)


def mcap_file(path: Path) -> Path:
    """The .mcap file of a bag, which may be without metadata.

    Raises:
        BagError: there is none, or several.
    """
    if path.is_file() and path.suffix == ".mcap":
        return path
    files = sorted(path.glob("*.mcap"))
    if len(files) != 1:
        raise BagError(
            f"{path}: not a bag, it holds {len(files)} .mcap files: give a rosbag2 folder"
        )
    return files[0]


def stamp(message: Any) -> int:
    """header.stamp [ns]."""
    return nanoseconds(message.header.stamp)


def nanoseconds(time: Any) -> int:
    """A builtin_interfaces/Time as an integer, since a double near 2e9 s would round to 0.2 us."""
    return int(time.sec) * 10**9 + int(time.nanosec)


def policy_window(messages: Messages) -> tuple[int, int]:
    """Stamps [ns] after and up to which the policy ran; all of the series if nobody told.

    That is of the stress, or of the object's poses where no stress was recorded.
    """
    series = [stamp(m) for m in messages["/stress"] or messages["/object_pose"]]
    states = messages["/trial_state"]
    if states and states[-1].state == FINISHED:
        started, ended = nanoseconds(states[-1].started), nanoseconds(states[-1].ended)
        if 0 < started < ended:
            return started, ended
    # Failed or cut off: from when it last began to run.
    running = len(states)
    while running and states[running - 1].state != RUNNING:
        running -= 1
    while running and states[running - 1].state == RUNNING:
        running -= 1
    began = next((stamp(m) for m in states[running:] if m.state == RUNNING), min(series))
    return began, max(series)
