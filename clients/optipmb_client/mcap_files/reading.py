"""Reading recordings, also those that were cut off: everything up to the cut is given."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from mcap.records import Channel, DataEnd, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from optipmb_schemas import MessageError
from optipmb_schemas.model import check_stream

from optipmb_client.files import DatasetError
from optipmb_client.mcap_files.writing import ENCODING, KINDS

__all__ = ["Recorded", "RecordingFile"]

_WHAT = "a recording (MCAP file)"
_LARGEST = 2**30
"""Bytes of the largest record that is read: chunks have a few megabytes, a damaged length may say anything."""


@dataclass(frozen=True)
class Recorded:
    """A message of a recording.

    Attributes:
        stream: Name of its stream.
        topic: Last part of its key: `detections`, `points`, `tracks`, `problems`, `parameters`.
        payload: Its bytes.
        encoding: Its Zenoh encoding.
        received_ns: When it was received, ns since 1970 UTC.
        stamp_ns: The stamp in it; where it has none, the same as `received_ns`.
    """

    stream: str
    topic: str
    payload: bytes
    encoding: str
    received_ns: int
    stamp_ns: int


class RecordingFile:
    """A recording on disk; iterating gives its messages as they were received, again at every iteration.

    Attributes:
        path: The file.
        cut: Whether the file ends in the middle, as after a kill; known once it has been read to its end.
        about: What the recording tells of itself; as `cut`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut = False
        self.about: dict[str, str] = {}

    def __iter__(self) -> Iterator[Recorded]:
        """Iterate over the messages of this product; those of others, and what is for viewers, are left out.

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
                if isinstance(record, Channel):
                    if (named := _names(record)) is not None:
                        channels[record.id] = named
                elif isinstance(record, Message):
                    if (known := channels.get(record.channel_id)) is not None:
                        yield Recorded(*known[:2], record.data, known[2], record.log_time, record.publish_time)
                elif isinstance(record, Metadata) and record.name == "optipmb":
                    self.about = record.metadata
                elif isinstance(record, DataEnd):
                    self.cut = False
                    return
        except Exception as error:  # half a record reads as many kinds of nonsense
            if file.read(1):
                raise DatasetError(self.path, _WHAT, f"damaged content ({type(error).__name__})") from error


def _names(channel: Channel) -> tuple[str, str, str] | None:
    """Return stream, topic and encoding of a channel of ours."""
    chunks = channel.topic.split("/")
    at = -2 if chunks[-2:-1] == ["q"] else -1
    if chunks[-1] not in KINDS or ENCODING not in channel.metadata:
        return None
    try:
        return check_stream("/".join(chunks[at - 3 : at])), chunks[-1], channel.metadata[ENCODING]
    except MessageError:
        return None
