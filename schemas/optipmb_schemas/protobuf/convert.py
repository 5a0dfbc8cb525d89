"""From models to protobuf messages and back. Columns are carried as bytes: neither way looks at their values.

`from_proto` builds what `decode` builds of msgpack and checks it in the same way, so that both forms have the same
limits and the same errors. It is total: it returns a model or raises `MessageError`.

`transcode` takes tracks from msgpack to protobuf without a model between them: a service has checked the
tracks that it publishes. The checks here do not look at values: the structure, the types, and that each
column has the rows of the others and the bytes of its shape. A receiver that wants more has `from_proto`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from math import prod
from typing import Any, Final, Self, TypeVar

import numpy as np
from google.protobuf import struct_pb2
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtoMessage
from msgspec import UNSET
from msgspec.structs import asdict
from numpy.typing import NDArray

from optipmb_schemas.codec import (
    DECODERS,
    DTYPES,
    REFUSED,
    build,
    decode,
    encoding_of,
)
from optipmb_schemas.errors import MessageError, invalid
from optipmb_schemas.limits import DEFAULT, Limits
from optipmb_schemas.messages import Tracks
from optipmb_schemas.model import Message
from optipmb_schemas.protobuf import tracking_pb2 as pb

T = TypeVar("T", bound=Message)
P = TypeVar("P", bound=ProtoMessage)

_DTYPE_NAMES: Final[dict[int, str]] = {
    code: name.rpartition("_")[2].lower() for name, code in pb.DataType.items() if code
}
_DTYPES: Final = {code: np.dtype(f"<{name}") for code, name in _DTYPE_NAMES.items()}
DTYPE_CODES: Final[dict[str, Any]] = {name: code for code, name in _DTYPE_NAMES.items()}
_FRAMES: Final[dict[int, str]] = {pb.FRAME_WORLD: "world", pb.FRAME_SENSOR: "sensor"}
_FRAME_CODES: Final = {name: code for code, name in _FRAMES.items()}
_ENCODING: Final = encoding_of(Tracks)
_SCALARS: Final = tuple(name for name in Tracks.names if name not in Tracks.arrays)


def parse(payload: bytes, kind: type[P]) -> P:
    """Return the protobuf message of the bytes.

    Raises:
        MessageError: they are none.
    """
    try:
        return kind.FromString(payload)
    except DecodeError:
        name = kind.DESCRIPTOR.full_name
        raise MessageError("malformed", "", f"a message {name}", f"{len(payload)} bytes that are none") from None


def to_proto(message: Message) -> Any:
    """Return the protobuf message of a model, which must have one: `export.MODELS`."""
    kind = type(message)
    fields: dict[str, Any] = {}
    for name, value in message.present():
        if isinstance(value, np.ndarray):
            described = kind.arrays[name]  # arrays of a fixed size are lists of numbers in protobuf
            fields[name] = _array(value, described.dtype) if described.rows else value.tolist()
        elif isinstance(value, Message):
            fields[name] = to_proto(value)
        elif isinstance(value, tuple) and value and isinstance(value[0], Message):
            fields[name] = [to_proto(one) for one in value]
        elif name == "frame":
            fields[name] = _FRAME_CODES[value]
        else:
            fields[name] = value  # protobuf makes a Struct of a map
    return getattr(pb, kind.__name__)(**fields)


def from_proto(proto: ProtoMessage, kind: type[T], limits: Limits = DEFAULT) -> T:
    """Return the model of a protobuf message.

    Raises:
        MessageError: whenever it is not a valid message within the limits.
    """
    return build(_fields(proto), kind, limits)


def column(array: pb.Array) -> NDArray[Any]:
    """Return a column that was checked before as an array, a view of its bytes."""
    dtype = _DTYPES[array.dtype]
    return np.frombuffer(array.data, dtype).reshape(array.shape) if array.data else np.empty(array.shape, dtype)


def select(array: pb.Array, rows: NDArray[np.bool_]) -> None:
    """Leave only some rows in a column that was checked before."""
    left = column(array)[rows]
    array.shape[0] = len(left)
    array.data = left.tobytes()


def _array(array: NDArray[Any], dtype: str) -> pb.Array:
    data = np.ascontiguousarray(array, f"<{dtype}").tobytes()
    return pb.Array(dtype=DTYPE_CODES[dtype], shape=array.shape, data=data)


def _fields(proto: ProtoMessage) -> dict[str, Any]:
    """Return the fields as `build` takes them. An absent one that can tell so, or a list of messages, is left out."""
    present = {field.name for field, _ in proto.ListFields()}
    return {
        name: read(getattr(proto, name))
        for name, read, can_be_absent in _readers(proto.DESCRIPTOR.full_name)
        if not can_be_absent or name in present
    }


@cache
def _readers(name: str) -> list[tuple[str, Callable[[Any], Any], bool]]:
    """Return of every field of a message type its name, how to read it, and whether it can be absent."""
    fields = pb.DESCRIPTOR.message_types_by_name[name.rpartition(".")[2]].fields
    return [
        (field.name, _reader(field), field.has_presence or (field.is_repeated and field.message_type is not None))
        for field in fields
    ]


def _reader(field: FieldDescriptor) -> Callable[[Any], Any]:
    if field.is_repeated:
        return list if field.message_type is None else lambda values: [_fields(one) for one in values]
    if field.enum_type is not None:
        return _frame
    if field.message_type is None:
        return lambda value: value
    if field.message_type.full_name == pb.Array.DESCRIPTOR.full_name:
        return _block
    if field.message_type.full_name == struct_pb2.Struct.DESCRIPTOR.full_name:
        return MessageToDict
    return _fields


def _frame(code: int) -> str:
    frame = _FRAMES.get(code)
    if frame is None:
        raise invalid("frame", "FRAME_WORLD or FRAME_SENSOR", code)
    return frame


def _block(array: pb.Array) -> dict[str, Any]:
    return {"dtype": _DTYPE_NAMES.get(array.dtype, array.dtype), "shape": list(array.shape), "data": array.data}


@dataclass(frozen=True, slots=True)
class EncodedTracks:
    """The tracks of one frame in protobuf, and what tells this publication of them from others."""

    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    revision: int
    run: int
    payload: bytes
    """The message `Tracks`, serialized."""
    sensor: str = ""
    """Stream of the detections, where several share a session."""
    predicted_to_ns: int = 0
    """Time of the states, where they are predicted."""

    @classmethod
    def of(cls, proto: pb.Tracks, columns: bytes = b"") -> Self:
        """Return the tracks of a message, and of columns that are serialized already."""
        payload = proto.SerializeToString() + columns
        place = (proto.stream, proto.epoch, proto.seq, proto.stamp_ns)
        return cls(*place, proto.revision, proto.delivery.run, payload, proto.sensor, proto.predicted_to_ns)

    def message(self) -> pb.Tracks:
        """Return the message."""
        return pb.Tracks.FromString(self.payload)


def transcode(payload: bytes, *, encoding: str = "", limits: Limits = DEFAULT) -> EncodedTracks:
    """Return encoded tracks in protobuf, their columns as they are.

    Args:
        payload: msgpack or JSON.
        encoding: the Zenoh encoding of the sample.
        limits: of messages.

    Raises:
        MessageError: they are no tracks within the limits.
    """
    if encoding == _ENCODING and len(payload) <= limits.max_bytes:
        try:
            tracks = _tracks(DECODERS[Tracks](payload), limits)
        except REFUSED:
            tracks = None  # decoding names the fault, if any
        if tracks is not None:
            return tracks
    return EncodedTracks.of(to_proto(decode(payload, Tracks, encoding=encoding, limits=limits)))


def _tracks(fields: Any, limits: Limits) -> EncodedTracks | None:
    """Return the tracks of fields that are as a service writes them, else None.

    Fields that are not known here are of a newer version, and are left out.
    """
    scalars = {name: value for name in _SCALARS if (value := getattr(fields, name)) is not UNSET}
    if len(fields.labels) > limits.max_labels or None in scalars.values() or "relocation" in scalars:
        return None
    (rows,), (horizons,) = fields.id.shape, fields.horizons.shape or (0,)
    if not (0 <= rows <= limits.max_tracks and 0 <= horizons <= limits.max_horizons):
        return None
    parts: list[bytes] = []
    for name, shape, size, prefix in _columns(rows, horizons, len(fields.labels)):
        block = getattr(fields, name)
        if block.shape is not None:  # else it is absent
            if block.shape != shape or len(block.data) != size:
                return None
            parts += (prefix, block.data)
    if "delivery" in scalars:
        scalars["delivery"] = {name: one for name, one in asdict(fields.delivery).items() if one is not UNSET}
    return EncodedTracks.of(pb.Tracks(**scalars), b"".join(parts))


@lru_cache(512)
def _columns(rows: int, horizons: int, classes: int) -> list[tuple[str, tuple[int, ...], int, bytes]]:
    """Return of each column name, shape, bytes, and what stands before them in the serialized message."""
    sizes, columns = {"N": rows, "H": horizons, "C": classes}, []
    for name, one in Tracks.arrays.items():
        shape = tuple(length if isinstance(length, int) else sizes[length] for length in one.shape)
        size = prod(shape) * DTYPES[one.dtype]
        proto: Any = pb.Tracks()
        getattr(proto, name).CopyFrom(pb.Array(dtype=DTYPE_CODES[one.dtype], shape=shape, data=bytes(size)))
        field: bytes = proto.SerializeToString()
        columns.append((name, shape, size, field[: len(field) - size]))
    return columns
