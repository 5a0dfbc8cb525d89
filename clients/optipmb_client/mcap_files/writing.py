"""Writing recordings.

Messages gather in a chunk that is compressed and written when it is full or at `flush`. What was flushed survives a
kill; the index at the end of the file comes with `close`.
"""

import contextlib
import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Self

from mcap.writer import CompressionType, Writer
from optipmb_schemas import Detections, Message, MessageError, Points, Problem, SessionParameters, Tracks, decode
from optipmb_schemas.codec import MAJOR
from optipmb_schemas.export import schema_of

from optipmb_client.foxglove_messages import FoxgloveMessages, Shown

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


class RecordingWriter:
    """A new MCAP file that messages are added to, by any threads.

    Args:
        path: The file; it must not be there yet.
        about: What is said of the recording as a whole.

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
            message = None  # what a publisher gets wrong is part of the incident
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
        """Write what was added so far, so that a kill cannot take it; return the size of the file in bytes."""
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
