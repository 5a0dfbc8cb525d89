"""Tracks as a bag: one MCAP file with objects, detections with ids, and markers, as all of ROS 2 reads them.

Topics stand below that of the detections: `…/tracks` and, below it, `detections`, `markers`, `predicted`. A message is
received, as far as the bag is concerned, when its detections were. The file appears whole, or not at all.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path

from optipmb_schemas import Tracks
from optipmb_schemas.ros2.tracks import TOPICS, messages
from optipmb_schemas.ros2.types import Types, own_types
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from optipmb_client.datasets.bag import Bag, Plan
from optipmb_client.files import DatasetError


def write_bag(path: Path, bag: Bag, plan: Plan, tracks: Mapping[int, Tracks], *, keep_input: bool) -> Path:
    """Write the tracks (world frame) of one topic of a bag, by frame index.

    Args:
        path: The file; returned.
        bag: Where the detections come from.
        plan: What is tracked of it.
        tracks: The tracks of each frame.
        keep_input: Also copy every message of the bag.

    Raises:
        DatasetError: A topic that is to be copied has a type that the bag does not define.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        writer = Writer(Path(folder) / path.stem, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        types = own_types()
        with writer:
            copied = {one.topic: _copy_topic(bag, one, writer, types) for one in bag.connections if keep_input}
            given = bag.messages(copied)
            ahead = next(given, None) if copied else None
            topics = {
                end: writer.add_connection(
                    f"{plan.topic}/tracks{end}",
                    kind,
                    msgdef=types.definition(kind),
                    rihs01=types.hash_of(kind),
                )
                for end, kind in TOPICS.items()
            }
            for index in sorted(tracks):
                frame = plan.frames[index]
                while ahead is not None and ahead.received_ns <= frame.received_ns:
                    writer.write(copied[ahead.topic], ahead.received_ns, ahead.data)
                    ahead = next(given, None)
                for end, message in messages(types, tracks[index], frame.stamp_ns, plan.world, plan.topic):
                    writer.write(topics[end], frame.received_ns, types.write(message))
            while ahead is not None:
                writer.write(copied[ahead.topic], ahead.received_ns, ahead.data)
                ahead = next(given, None)
        (made,) = (Path(folder) / path.stem).glob("*.mcap")
        made.replace(path)
    return path


def _copy_topic(bag: Bag, one: Connection, writer: Writer, types: Types) -> Connection:
    defined = one.msgdef.format != MessageDefinitionFormat.NONE
    try:
        definition = one.msgdef.data if defined else types.definition(one.msgtype)
        digest = one.digest or types.hash_of(one.msgtype)
    except KeyError:
        received = f"{one.msgtype} on {one.topic}, which it does not define"
        raise DatasetError(bag.path, "types that the bag defines, to copy them", received) from None
    assert isinstance(one.ext, ConnectionExtRosbag2)  # noqa: S101  the other kind is of ROS 1
    return writer.add_connection(
        one.topic,
        one.msgtype,
        msgdef=definition,
        rihs01=digest,
        serialization_format=one.ext.serialization_format,
        offered_qos_profiles=one.ext.offered_qos_profiles,
    )
