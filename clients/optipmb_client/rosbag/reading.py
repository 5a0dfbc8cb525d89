"""A bag: which topics it has, its messages in the order in which they were received, and what they say."""

import contextlib
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from optipmb_schemas import MessageError
from optipmb_schemas.ros2.types import Types
from rosbags.rosbag2 import Reader, ReaderError

from optipmb_client.files import DatasetError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


_CDR: Final = 4  # bytes ahead of the fields; the second tells the order of the bytes of numbers


class Raw(NamedTuple):
    """A message as it is in the bag."""

    topic: str
    received_ns: int
    data: bytes


class Stamped(NamedTuple):
    """The header of a message: stamp in nanoseconds, and frame."""

    stamp_ns: int
    frame: str


class Bag:
    """A rosbag2 folder, or one MCAP or SQLite file of it.

    Args:
        path: the folder with `metadata.yaml`, or the file.

    Raises:
        DatasetError: it is none, or was not closed properly.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with contextlib.closing(self._reader()) as reader:
            self.connections: tuple[Connection, ...] = tuple(reader.connections)
        self.topics: dict[str, str] = {one.topic: one.msgtype for one in self.connections}
        self._definitions = {one.msgtype: one.msgdef for one in self.connections}
        self._types: dict[str, Types] = {}

    def of_type(self, *names: str) -> tuple[str, ...]:
        """Return the topics of some types, ordered by name."""
        return tuple(sorted(topic for topic, name in self.topics.items() if name in names))

    def messages(self, topics: Collection[str]) -> Iterator[Raw]:
        """Yield the messages of some topics in the order in which they were received."""
        with contextlib.closing(self._reader()) as reader:
            chosen = [one for one in reader.connections if one.topic in topics]
            if not chosen:
                return
            try:
                for connection, received_ns, data in reader.messages(chosen):
                    yield Raw(connection.topic, received_ns, data)
            except (ReaderError, EOFError, struct.error) as error:
                raise DatasetError(self.path, "whole messages", str(error)) from error

    def read(self, raw: Raw) -> Any:
        """Return what a message says.

        Raises:
            DatasetError: its bytes are no message of the topic's type.
        """
        name = self.topics[raw.topic]
        if name not in self._types:
            try:
                self._types[name] = Types({name: self._definitions[name]})
            except MessageError as error:
                raise self.wrong(raw, error) from error
        try:
            return self._types[name].read(name, raw.data)
        except MessageError as error:
            raise self.wrong(raw, error) from error

    def header(self, raw: Raw) -> Stamped:
        """Return the header that a message begins with, without reading the rest.

        Raises:
            DatasetError: there is none.
        """
        order = "<" if raw.data[1:2] == b"\x01" else ">"
        try:
            second, rest, length = struct.unpack_from(order + "iII", raw.data, _CDR)
            start = _CDR + 12
            if second < 0 or rest >= 10**9 or not 0 < length <= len(raw.data) - start:
                raise ValueError  # noqa: TRY301 - reported below
            frame = raw.data[start : start + length - 1].decode()
        except (struct.error, ValueError) as error:
            raise DatasetError(f"{self.path} {raw.topic}", "a header", f"{len(raw.data)} bytes without one") from error
        return Stamped(second * 10**9 + rest, frame.removeprefix("/"))

    def wrong(self, raw: Raw, error: MessageError) -> DatasetError:
        """Return an error that says which message of the bag is wrong."""
        place = f"{self.path} {raw.topic}, received at {raw.received_ns} ns"
        return DatasetError(f"{place}: {error.path}" if error.path else place, error.expected, error.received)

    def _reader(self) -> Reader:
        what = "a bag of ROS 2 (a folder with metadata.yaml, or an .mcap or .db3 file)"
        try:
            reader = Reader(self.path)
            reader.open()
        except FileNotFoundError as error:
            received = "a folder without metadata.yaml" if self.path.is_dir() else "nothing"
            raise DatasetError(self.path, what, received) from error
        except (ReaderError, EOFError, struct.error, TypeError) as error:
            hint = " (if the recorder was killed: mcap recover, or ros2 bag reindex)"
            raise DatasetError(self.path, what, f"{error}{hint}") from error
        return reader
