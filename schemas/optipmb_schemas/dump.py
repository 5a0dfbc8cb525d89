"""What a service saves when tracking a stream fails, so that the failure can be had again elsewhere.

A dump holds the density before the last frames, these frames as the messages that brought them, the parameters, and
which software it was. It is one msgpack map, and does not depend on the service: `optipmb track --dump` reads it.
"""

from dataclasses import dataclass, field
from typing import Annotated, Any, Final, TypeVar

import msgpack
from pydantic import BeforeValidator, PlainSerializer, StrictBool, StrictBytes, StrictInt, TypeAdapter, ValidationError

from optipmb_schemas.codec import decode, encode, read_map
from optipmb_schemas.errors import MessageError, invalid, show
from optipmb_schemas.limits import Limits
from optipmb_schemas.messages import Detections, Points
from optipmb_schemas.model import Message, first_error

T = TypeVar("T", bound=Message)

FORMAT: Final = "optipmb-dump"
VERSION: Final = 1
MAX_BYTES: Final = 2**30

STORED: Final = Limits(
    max_bytes=MAX_BYTES, max_text=2**20, max_points=2**26, max_detections=2**20, max_values=2**22, max_labels=2**16
)
"""What messages in files of our own may hold: they were inside the limits of the service that wrote them."""

_msgpack: Any = msgpack  # its type information is partial


def _stored(data: object, kind: type[T]) -> T:
    if not isinstance(data, bytes):
        raise invalid("", "bytes", data)
    return decode(data, kind, limits=STORED)


_ENCODED: Final = PlainSerializer(lambda message: None if message is None else encode(message))


@dataclass(frozen=True)
class DumpedFrame:
    """One of the last frames.

    Attributes:
        detections: the message.
        points: its cloud.
        anew: whether the frame starts with an empty density, in which only the next track id goes on.
    """

    detections: Annotated[Detections, BeforeValidator(lambda data: _stored(data, Detections)), _ENCODED]
    points: Annotated[Points | None, BeforeValidator(lambda data: data and _stored(data, Points)), _ENCODED]
    anew: StrictBool


@dataclass(frozen=True)
class Dump:
    """What a failure needs to happen again.

    Attributes:
        stream: `site/node/sensor`.
        error: type and text of the exception.
        trace: where it was raised, for people.
        versions: of the software, by name.
        parameters: the profile, as nested maps.
        stamp_ns: stamp of the density; -1 before the first frame.
        next_id: its next track id.
        density: its arrays as bytes, one string for each part.
        frames: the last frames in the order of processing; the error was raised by one of them.
        sensors: the parameters of the sensors that have others, by stream.
    """

    stream: str
    error: str
    trace: str
    versions: dict[str, str]
    parameters: dict[str, Any]
    stamp_ns: StrictInt
    next_id: StrictInt
    density: dict[str, StrictBytes]
    frames: tuple[DumpedFrame, ...]
    sensors: dict[str, dict[str, Any]] = field(default_factory=dict)


def encode_dump(dump: Dump) -> bytes:
    """Return the bytes of a dump."""
    without = None if dump.sensors else {"sensors"}
    packed: bytes = _msgpack.packb({"format": FORMAT, "version": VERSION} | _DUMP.dump_python(dump, exclude=without))
    return packed


def decode_dump(payload: bytes) -> Dump:
    """Return the dump that bytes hold.

    Raises:
        MessageError: they hold none, or one of another version.
    """
    fields = read_map(payload, STORED)
    if fields.get("format") != FORMAT:
        raise MessageError("malformed", "format", FORMAT, "another file")
    if (version := fields.get("version")) != VERSION:
        raise MessageError("unsupported_version", "version", str(VERSION), show(version))
    try:
        return _DUMP.validate_python(fields)
    except ValidationError as error:
        raise first_error(error) from None


_DUMP: Final = TypeAdapter(Dump)
