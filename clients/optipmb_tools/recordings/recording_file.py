"""Recordings on disk: MCAP files, written in chunks, and read back however they ended.

Messages gather in a chunk that is compressed and written when it is full or at `flush`. Flushed messages survive a
kill; the index at the end of the file comes with `close`. A file that was cut off is read up to the cut.
"""

import contextlib
import json
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, Self

from mcap import records
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from optipmb_schemas import Detections, Message, MessageError, Points, Problem, SessionParameters, Tracks, decode
from optipmb_schemas.codec import MAJOR
from optipmb_schemas.export import schema_of
from optipmb_schemas.model import check_stream

from optipmb_tools.files import DatasetError
from optipmb_tools.views.foxglove import FoxgloveMessages, Shown

# Message types by the last part of their keys
KINDS: Final[dict[str, type[Message]]] = {
    "detections": Detections,
    "points": Points,
    "tracks": Tracks,
    "problems": Problem,
    "parameters": SessionParameters,
}

ENCODING: Final = "encoding"  # name in the metadata of a channel under which the Zenoh encoding of its messages stands

CHUNK: Final = 4 * 2**20
SEQUENCES: Final = 2**32
_WHAT = "a recording (MCAP file)"
_LARGEST = 2**30
"""Bytes of the largest record that is read: chunks have a few megabytes, a damaged length may say anything."""


@dataclass(frozen=True)
class Recorded:
    """A message of a recording."""

    stream: str
    topic: str  # last part of its key: `detections`, `points`, `tracks`, `problems`, `parameters`
    payload: bytes
    encoding: str  # of Zenoh
    received_ns: int  # ns since 1970 UTC
    stamp_ns: int  # stamp of the message, or `received_ns` without one


class RecordingFile:
    """A recording on disk; iterating gives its messages as they were received, again at every iteration.

    Attributes:
        path: The file.
        cut: Whether the file ends in the middle, as after a kill; known once it has been read to its end.
        about: Metadata of the recording; as `cut`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut = False
        self.about: dict[str, str] = {}

    def __iter__(self) -> Iterator[Recorded]:
        """Iterate over the messages of streams; messages for viewers are left out.

        Raises:
            DatasetError: The file cannot be read, is no MCAP file, or is damaged.
        """
        channels: dict[int, tuple[str, str, str]] = {}
        self.cut = True
        try:
            with self.path.open("rb") as file:
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    raise DatasetError(self.path, _WHAT, "another kind of file")
                reader = StreamReader(file, skip_magic=True, validate_crcs=True, record_size_limit=_LARGEST)
                yield from self._messages(reader, channels, file)
        except OSError as error:
            raise DatasetError(self.path, _WHAT, error.strerror or "an unreadable file") from error

    def _messages(
        self, reader: StreamReader, channels: dict[int, tuple[str, str, str]], file: IO[bytes]
    ) -> Iterator[Recorded]:
        try:
            for record in reader.records:
                if isinstance(record, records.Channel):
                    if (named := _names(record)) is not None:
                        channels[record.id] = named
                elif isinstance(record, records.Message):
                    if (known := channels.get(record.channel_id)) is not None:
                        yield Recorded(*known[:2], record.data, known[2], record.log_time, record.publish_time)
                elif isinstance(record, records.Metadata) and record.name == "optipmb":
                    self.about = record.metadata
                elif isinstance(record, records.DataEnd):
                    self.cut = False
                    return
        except Exception as error:  # half a record reads as many kinds of nonsense
            if file.read(1):
                raise DatasetError(self.path, _WHAT, f"damaged content ({type(error).__name__})") from error


def _names(channel: records.Channel) -> tuple[str, str, str] | None:
    """Return stream, topic and encoding of a channel of ours."""
    chunks = channel.topic.split("/")
    at = -2 if chunks[-2:-1] == ["q"] else -1
    if chunks[-1] not in KINDS or ENCODING not in channel.metadata:
        return None
    try:
        return check_stream("/".join(chunks[at - 3 : at])), chunks[-1], channel.metadata[ENCODING]
    except MessageError:
        return None


class RecordingWriter:
    """A new MCAP file that messages are added to, by any threads.

    Args:
        path: The file; it must not be there yet.
        about: Metadata of the recording.

    Raises:
        FileExistsError: It is there.
    """

    def __init__(self, path: Path, about: dict[str, str] | None = None) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file = path.open("xb")
        self._writer = Writer(self._file, chunk_size=CHUNK, compression=CompressionType.ZSTD)
        self._lock = threading.Lock()
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._foxglove = FoxgloveMessages()
        self._closed = False
        self._size = 0
        self.messages = 0
        self._writer.start()
        self._writer.add_metadata("optipmb", about or {})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, key: str, payload: bytes, encoding: str, received_ns: int) -> Message | None:
        """Append a message as it came in, valid or not, and return it; None when it is not valid, or came too late.

        Args:
            key: Where it was published; its last part tells its type.
            payload: Its bytes, which are kept as they are.
            encoding: Its Zenoh encoding.
            received_ns: When it was received, ns since 1970 UTC.
        """
        kind = KINDS[key.rpartition("/")[2]]
        try:
            message: Message | None = decode(payload, kind, encoding=encoding)
        except MessageError:
            message = None  # invalid messages are part of the incident
        stamp_ns = getattr(message, "stamp_ns", None)
        stamp_ns = received_ns if stamp_ns is None or stamp_ns < 0 else stamp_ns
        sequence = (getattr(message, "seq", None) or 0) % SEQUENCES
        # Clouds would double the size of the file: they are shown live alone.
        shown = [] if message is None or isinstance(message, Points) else list(self._foxglove.of(message))
        with self._lock, self._naming_file():
            if self._closed:
                return None
            channel = self._channel(key, kind, payload, encoding)
            self._writer.add_message(channel, received_ns, payload, stamp_ns, sequence)
            self.messages += 1
            for one in shown:
                self._writer.add_message(self._shown_channel(key, one), received_ns, one.payload, stamp_ns, sequence)
        return message

    def flush(self) -> int:
        """Write all messages so far, so that they survive a kill; return the size of the file in bytes."""
        with self._lock, self._naming_file():
            if not self._closed:
                self._writer.flush()
                self._size = self._file.tell()
            return self._size

    def close(self) -> None:
        """Write the index and close the file. May be called twice."""
        with self._lock, self._naming_file():
            if not self._closed:
                self._closed = True
                with self._file:
                    self._writer.finish()
                    self._size = self._file.tell()

    @contextlib.contextmanager
    def _naming_file(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from error

    def _channel(self, key: str, kind: type[Message], payload: bytes, encoding: str) -> int:
        """Return the channel of a key and encoding: a publisher may change from msgpack to JSON."""
        if (key, encoding) not in self._channels:
            form = "json" if "json" in encoding or payload[:1] == b"{" else "msgpack"
            name = f"optipmb.{kind.__name__}.v{MAJOR}"
            if name not in self._schemas:
                text = json.dumps(schema_of(kind), sort_keys=True)
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", text.encode())
            about = {ENCODING: encoding}
            self._channels[key, encoding] = self._writer.register_channel(key, form, self._schemas[name], about)
        return self._channels[key, encoding]

    def _shown_channel(self, key: str, one: Shown) -> int:
        topic = f"{key}{one.end}"
        if (topic, "") not in self._channels:
            name = one.schema.name
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, one.schema.encoding, one.schema.data)
            self._channels[topic, ""] = self._writer.register_channel(topic, one.encoding, self._schemas[name])
        return self._channels[topic, ""]
