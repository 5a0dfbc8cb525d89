"""What a service saves when tracking a stream fails, so that the failure can be had again elsewhere.

A dump holds the density before the last frames, these frames as the messages that brought them, the parameters, and
which software it was. It is one msgpack map, and does not depend on the service: `optipmb track --dump` reads it.
"""

from dataclasses import dataclass
from typing import Any, Final

import msgpack

from optipmb_schemas.codec import decode
from optipmb_schemas.encoder import encode
from optipmb_schemas.errors import MessageError, invalid
from optipmb_schemas.limits import Limits
from optipmb_schemas.messages import Detections, Points
from optipmb_schemas.structure import check_msgpack

FORMAT: Final = "optipmb-dump"
VERSION: Final = 1
MAX_BYTES: Final = 2**30

STORED: Final = Limits(
    max_bytes=MAX_BYTES, max_text=2**20, max_points=2**26, max_detections=2**20, max_values=2**22, max_labels=2**16
)
"""What messages in files of our own may hold: they were inside the limits of the service that wrote them."""

_msgpack: Any = msgpack  # its type information is partial


@dataclass(frozen=True)
class DumpedFrame:
    """One of the last frames.

    Attributes:
        detections: the message.
        points: its cloud.
        anew: whether the density is empty before it, but for the next track id.
    """

    detections: Detections
    points: Points | None
    anew: bool


@dataclass(frozen=True)
class Dump:
    """What a failure needs to happen again.

    Attributes:
        stream: `site/node/sensor`.
        error: type and text of what was raised.
        trace: where it was raised, for people.
        versions: of the software, by name.
        parameters: the profile, as nested maps.
        stamp_ns: stamp of the density; -1 before the first frame.
        next_id: its next track id.
        density: its arrays as bytes, one string for each part.
        frames: the last frames in the order of processing; the error was raised by one of them.
    """

    stream: str
    error: str
    trace: str
    versions: dict[str, str]
    parameters: dict[str, Any]
    stamp_ns: int
    next_id: int
    density: dict[str, bytes]
    frames: tuple[DumpedFrame, ...]


def encode_dump(dump: Dump) -> bytes:
    """Return the bytes of a dump."""
    fields = {
        "format": FORMAT,
        "version": VERSION,
        **{name: value for name, value in vars(dump).items() if name != "frames"},
        "frames": [
            {
                "detections": encode(frame.detections),
                "points": None if frame.points is None else encode(frame.points),
                "anew": frame.anew,
            }
            for frame in dump.frames
        ],
    }
    packed: bytes = _msgpack.packb(fields)
    return packed


def decode_dump(payload: bytes) -> Dump:
    """Return the dump that bytes hold.

    Raises:
        MessageError: they hold none, or one of another version.
    """
    check_msgpack(payload, STORED)
    try:
        fields = _msgpack.unpackb(payload, strict_map_key=True)
    except ValueError as error:
        raise MessageError("malformed", "", "a dump", type(error).__name__) from None
    if not isinstance(fields, dict) or fields.get("format") != FORMAT:
        raise MessageError("malformed", "format", FORMAT, "another file")
    version = fields.get("version")
    if version != VERSION:
        raise MessageError("unsupported_version", "version", str(VERSION), str(version)[:20])
    kinds: dict[str, type] = {"stream": str, "error": str, "trace": str, "versions": dict, "parameters": dict}
    kinds |= {"density": dict, "stamp_ns": int, "next_id": int, "frames": list}
    for name, kind in kinds.items():
        if not isinstance(fields.get(name), kind):
            raise invalid(name, f"a value of type {kind.__name__}", fields.get(name))
    frames = tuple(_frame(index, value) for index, value in enumerate(fields["frames"]))
    versions = {str(name): str(value) for name, value in fields["versions"].items()}
    plain = {name: fields[name] for name in kinds if name not in {"frames", "versions"}}
    return Dump(**plain, versions=versions, frames=frames)


def _frame(index: int, value: object) -> DumpedFrame:
    if not isinstance(value, dict) or not isinstance(value.get("detections"), bytes):
        raise invalid(f"frames[{index}]", "a frame", value)
    points = value.get("points")
    if not isinstance(points, bytes | None):
        raise invalid(f"frames[{index}].points", "bytes", points)
    try:
        detections = decode(value["detections"], Detections, limits=STORED)
        cloud = None if points is None else decode(points, Points, limits=STORED)
        return DumpedFrame(detections, cloud, bool(value.get("anew")))
    except MessageError as error:
        raise error.under(f"frames[{index}]") from None
