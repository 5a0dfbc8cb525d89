"""Tracks as a bag: one MCAP file with objects, detections with ids, and markers, as all of ROS 2 reads them.

Topics stand below that of the detections: `…/tracks` and, below it, `detections`, `markers`, `predicted`. A message is
received, as far as the bag is concerned, when its detections were. The file appears whole at `close`, or not at all.
"""

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from optipmb_schemas import Tracks
from optipmb_schemas.ros2.tracks import TOPICS, messages
from optipmb_schemas.ros2.types import own_types
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from optipmb_client.files import DatasetError
from optipmb_client.geometry import PoseLike
from optipmb_client.results import ResultWriter
from optipmb_client.rosbag.plan import Plan
from optipmb_client.rosbag.reading import Bag, Raw

if TYPE_CHECKING:
    from collections.abc import Iterator


class BagResultWriter(ResultWriter):
    """Writes the tracks of one sequence of a bag; use it as a context manager.

    Args:
        path: the file to make.
        bag: where the detections come from.
        plan: what is tracked of it.
        keep_input: also copy every message of the bag.

    Raises:
        DatasetError: a topic that is to be copied has a type that the bag does not define.
    """

    def __init__(self, path: Path, bag: Bag, plan: Plan, *, keep_input: bool) -> None:
        super().__init__(path)
        self._plan = plan
        self._types = own_types()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        self._writer = Writer(self._folder / path.stem, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._closed = False
        self._input: Iterator[Raw] = iter(())
        self._next: Raw | None = None
        self._copied: dict[str, Connection] = {}
        try:
            self._writer.open()
            if keep_input:
                self._copied = {one.topic: self._copy_topic(bag, one) for one in bag.connections}
                self._input = bag.messages(self._copied)
                self._next = next(self._input, None)
            self._topics = {
                end: self._writer.add_connection(
                    f"{plan.topic}/tracks{end}",
                    kind,
                    msgdef=self._types.definition(kind),
                    rihs01=self._types.hash_of(kind),
                )
                for end, kind in TOPICS.items()
            }
        except BaseException:
            self.discard()
            raise

    def add(self, index: int, pose: PoseLike, tracks: Tracks) -> None:
        """Write the tracks (world frame) of frame `index`; `pose` is not needed, tf tells it."""
        del pose
        frame = self._plan.frames[index]
        self._copy_until(frame.received_ns)
        world, types, stamp_ns = self._plan.world, self._types, frame.stamp_ns
        for end, message in messages(types, tracks, stamp_ns, world, self._plan.topic):
            self._writer.write(self._topics[end], frame.received_ns, types.write(message))

    def close(self) -> None:
        """Copy what is left, and put the file in its place."""
        if self._closed:
            return
        self._copy_until(None)
        self._writer.close()
        self._closed = True
        (made,) = (self._folder / self.path.stem).glob("*.mcap")
        made.replace(self.path)
        shutil.rmtree(self._folder)

    def discard(self) -> None:
        """Drop what was written."""
        if not self._closed:
            self._closed = True
            self._writer.abort()
            shutil.rmtree(self._folder, ignore_errors=True)

    def _copy_topic(self, bag: Bag, one: Connection) -> Connection:
        defined = one.msgdef.format != MessageDefinitionFormat.NONE
        try:
            definition = one.msgdef.data if defined else self._types.definition(one.msgtype)
            digest = one.digest or self._types.hash_of(one.msgtype)
        except KeyError:
            received = f"{one.msgtype} on {one.topic}, which it does not define"
            raise DatasetError(bag.path, "types that the bag defines, to copy them", received) from None
        assert isinstance(one.ext, ConnectionExtRosbag2)  # noqa: S101  the other kind is of ROS 1
        return self._writer.add_connection(
            one.topic,
            one.msgtype,
            msgdef=definition,
            rihs01=digest,
            serialization_format=one.ext.serialization_format,
            offered_qos_profiles=one.ext.offered_qos_profiles,
        )

    def _copy_until(self, received_ns: int | None) -> None:
        while self._next is not None and (received_ns is None or self._next.received_ns <= received_ns):
            self._writer.write(self._copied[self._next.topic], self._next.received_ns, self._next.data)
            self._next = next(self._input, None)
