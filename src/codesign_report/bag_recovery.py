"""A bag that was cut off, by a killed recorder or a full disk, as a whole one. Needs no ROS.

The recorder writes a piece of the file every half second. What lies before the first damaged piece
is copied; the index and metadata.yaml are made anew.
"""

import struct
import tempfile
from pathlib import Path

from codesign_report.bag_messages import BagError, mcap_file


def recover(bag: str | Path, out: str | Path) -> int:
    """Writes a new bag with every message that can be read.

    Args:
        bag: rosbag2 folder, or an .mcap file; it is not changed.
        out: folder of the new bag; must not exist.

    Returns:
        How many messages it holds.

    Raises:
        BagError: not a bag, nothing in it can be read, or `out` exists.
        OSError: `out` cannot be written.
    """
    source, target = mcap_file(Path(bag)), Path(out)
    if target.exists():
        raise BagError(f"{target}: exists already, choose a new folder")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as folder:
        whole = Path(folder, "whole.mcap")
        if not _copy_readable(source, whole):
            raise BagError(f"{source}: no message can be read: it was cut off too early")
        return _write_bag(whole, target)


def _copy_readable(source: Path, whole: Path) -> int:
    """Copies messages up to the first damaged place, under a new index; how many."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, DataEnd, Message, Schema
    from mcap.stream_reader import StreamReader
    from mcap.writer import CompressionType, Writer

    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    count = 0
    with source.open("rb") as damaged, whole.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="codesign")
        try:
            for record in StreamReader(damaged, record_size_limit=2**30).records:
                if isinstance(record, DataEnd):  # what follows is the index
                    break
                if isinstance(record, Schema) and record.id not in schemas:
                    schemas[record.id] = writer.register_schema(
                        record.name, record.encoding, record.data
                    )
                elif isinstance(record, Channel) and record.id not in channels:
                    channels[record.id] = writer.register_channel(
                        record.topic,
                        record.message_encoding,
                        schemas[record.schema_id],
                        record.metadata,
                    )
                elif isinstance(record, Message):
                    writer.add_message(
                        channels[record.channel_id],
                        record.log_time,
                        record.data,
                        record.publish_time,
                        record.sequence,
                    )
                    count += 1
        except (McapError, struct.error, ValueError, LookupError):
            pass  # the damaged place
        writer.finish()
    return count


def _write_bag(whole: Path, target: Path) -> int:
    """The same messages as a rosbag2 folder, as the recorder would have left it."""
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import ConnectionExtRosbag2
    from rosbags.rosbag2 import StoragePlugin, Writer

    count = 0
    with (
        AnyReader([whole]) as reader,
        Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        copies = {}
        for connection in reader.connections:
            extra = connection.ext
            assert isinstance(extra, ConnectionExtRosbag2)
            copies[connection.id] = writer.add_connection(
                connection.topic,
                connection.msgtype,
                typestore=reader.typestore,
                serialization_format=extra.serialization_format,
                offered_qos_profiles=extra.offered_qos_profiles,
            )
        for connection, time, data in reader.messages():
            writer.write(copies[connection.id], time, data)
            count += 1
    return count
