"""From models to protobuf messages and back. Columns are carried as bytes: neither way looks at their values.

`from_proto` builds what `decode` builds of msgpack and checks it in the same way, so that both forms have the same
limits and the same errors. It is total: it returns a model or raises `MessageError`.
"""

from collections.abc import Callable
from functools import cache
from struct import pack
from typing import Any, Final, TypeVar

import msgspec
import numpy as np
from google.protobuf import struct_pb2
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.json_format import MessageToDict
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as ProtoMessage
from numpy.typing import NDArray

from optipmb_schemas.codec import build
from optipmb_schemas.decoder import DECODERS, MOST_BYTES, read
from optipmb_schemas.errors import MessageError, invalid
from optipmb_schemas.limits import DEFAULT, Limits
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
_pack: Final = msgspec.msgpack.Encoder().encode
_FRAME_CODES: Final = {name: code for code, name in _FRAMES.items()}


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
            fields[name] = value.tolist() if name in _repeated(kind) else _array(value, kind.arrays[name].dtype)
        elif isinstance(value, Message):
            fields[name] = to_proto(value)
        elif name == "frame":
            fields[name] = _FRAME_CODES[value]
        else:
            fields[name] = _struct(value) if isinstance(value, dict) else value
    return getattr(pb, kind.__name__)(**fields)


def from_proto(proto: ProtoMessage, kind: type[T], limits: Limits = DEFAULT) -> T:
    """Return the model of a protobuf message.

    Raises:
        MessageError: whenever it is not a valid message within the limits.
    """
    fields = _fields(proto)
    if kind in DECODERS and proto.ByteSize() <= MOST_BYTES:
        message = read(_pack(_with_blocks(fields, kind)), kind, limits)
        if message is not None:
            return message
    return build(fields, kind, limits)


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


def _with_blocks(fields: dict[str, Any], kind: type[Message]) -> dict[str, Any]:
    """Return the fields with arrays in place of the lists of numbers that protobuf has for arrays of a fixed size."""
    lists = {name: fields[name] for name in _repeated(kind) & fields.keys()}
    inner = {name: _with_blocks(fields[name], inner) for name, inner in kind.nested.items() if name in fields}
    return fields | inner | {name: _doubles(values) for name, values in lists.items()}


def _fields(proto: ProtoMessage) -> dict[str, Any]:
    """Return the fields as `build` takes them. An absent one that can tell so is left out."""
    return {
        name: read(getattr(proto, name))
        for name, read, has_presence in _readers(proto.DESCRIPTOR.full_name)
        if not has_presence or proto.HasField(name)
    }


@cache
def _readers(name: str) -> list[tuple[str, Callable[[Any], Any], bool]]:
    """Return of every field of a message type its name, how to read it, and whether it can be absent."""
    fields = pb.DESCRIPTOR.message_types_by_name[name.rpartition(".")[2]].fields
    return [(field.name, _reader(field), field.has_presence) for field in fields]


def _reader(field: FieldDescriptor) -> Callable[[Any], Any]:
    if field.is_repeated:
        return list
    if field.enum_type is not None:
        return _frame
    if field.message_type is None:
        return _same
    if field.message_type.full_name == pb.Array.DESCRIPTOR.full_name:
        return _block
    if field.message_type.full_name == struct_pb2.Struct.DESCRIPTOR.full_name:
        return MessageToDict
    return _fields


def _same(value: Any) -> Any:
    return value


def _frame(code: int) -> str:
    frame = _FRAMES.get(code)
    if frame is None:
        raise invalid("frame", "FRAME_WORLD or FRAME_SENSOR", code)
    return frame


def _block(array: pb.Array) -> dict[str, Any]:
    """Return an array as the block that msgpack has."""
    return {"dtype": _DTYPE_NAMES.get(array.dtype, array.dtype), "shape": list(array.shape), "data": array.data}


def _doubles(values: list[float]) -> dict[str, Any]:
    return {"dtype": "f8", "shape": [len(values)], "data": pack(f"<{len(values)}d", *values)}


@cache
def _repeated(kind: type[Message]) -> frozenset[str]:
    """Return the names of the arrays that are lists of numbers in protobuf: those of a fixed small size."""
    return frozenset(name for name, array in kind.arrays.items() if array.rows is None)


def _struct(values: dict[str, Any]) -> struct_pb2.Struct:
    struct = struct_pb2.Struct()
    struct.update(values)
    return struct
