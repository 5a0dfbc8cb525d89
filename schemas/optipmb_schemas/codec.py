"""Messages to bytes and back: pure and deterministic, so equal messages give equal bytes.

Decoding is total and bounded: for any bytes it returns a message or raises `MessageError`, and sizes, counts
and nesting are checked before memory is taken for them. A msgpack header of five bytes can declare four thousand
million items, and a byte per level can nest lists as deep as the payload is long. So the bytes are walked once, without
building anything, before the models read them.

An array is a block of the wire, `{"dtype": "f8", "shape": [M, 3], "data": <bytes>}`, little-endian, row by row, no
gaps. It becomes a view of the received bytes where they are aligned and of the wanted number type, and a copy
otherwise. The data of a large block lie at a multiple of 8 bytes from the start of the message (with the optional field
`pad`), so that the receiver's view is aligned.

Most messages with columns need neither the walk nor the models: msgspec decodes them by structs that come from the
models (`read_columns`). A payload that is not plainly a valid message is left to the models, which name the error. So
there is one set of rules and one set of errors. Tests hold the messages of both ways equal. By the models alone, a
frame of 40 objects costs the service 27 % more processor time.
"""

import json
import re
import struct
import sys
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from itertools import accumulate, chain, pairwise
from math import prod
from operator import attrgetter
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar, get_type_hints

import msgpack
import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from pydantic import AfterValidator, TypeAdapter
from typing_extensions import TypedDict

from optipmb_schemas.arrays import Array, Numeric, numeric
from optipmb_schemas.control import (
    DrainRequest,
    MoveRequest,
    Problem,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
    TracksRequest,
)
from optipmb_schemas.errors import MessageError, invalid, show
from optipmb_schemas.limits import DEFAULT, Limits
from optipmb_schemas.messages import Density, Detections, Events, FieldOfView, Links, Points, Pose, Relocation, Tracks
from optipmb_schemas.model import Message

T = TypeVar("T", bound=Message)

MESSAGES: Final[tuple[type[Message], ...]] = (
    Detections,
    Points,
    Tracks,
    Events,
    Links,
    SessionState,
    Density,
    SessionParameters,
    ResetRequest,
    MoveRequest,
    DrainRequest,
    Problem,
    ServiceStatus,
    TracksRequest,
)
"""Every type that is sent on its own."""

MAJOR: Final = 1
"""Major version of all messages. Another one has another encoding string and is refused."""

_ENCODING: Final = re.compile(r"application/(msgpack|json)(?:; ?optipmb\.([A-Za-z]{1,64})\.v([0-9]{1,6}))?")
_UNDECLARED: Final = frozenset({"", "zenoh/bytes", "zenoh/string"})  # what Zenoh says when a publisher says nothing
_JSON_STARTS: Final = frozenset(b"{ \t\r\n")  # in msgpack these are small integers, never the start of a map
_DIGITS: Final = 20  # of a 64-bit integer with its sign; the time to read longer ones grows with their square


DTYPES: Final = {name: int(name[1]) for name in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")}
"""Number types that a block may have, and their bytes. Numpy's spelling (`<f8`, `|u1`) is understood as well."""

LARGE: Final = 4096
"""Bytes from which on the encoder aligns a block's data."""

ALIGNMENT: Final = 8
"""Large blocks start at a multiple of this many bytes from the start of the message."""

_NAMES: Final = {f"{sign}{name}": name for name in DTYPES for sign in ("", "|" if DTYPES[name] == 1 else "<")}

_msgpack: Any = msgpack  # its type information is partial


def encoding_of(message: Message | type[Message], *, form: str = "msgpack") -> str:
    """Return the Zenoh encoding of a message or type, as `application/msgpack;optipmb.Detections.v1`."""
    kind = message if isinstance(message, type) else type(message)
    return f"application/{form};optipmb.{kind.__name__}.v{MAJOR}"


def decode(payload: bytes, expected: type[T], *, encoding: str = "", limits: Limits = DEFAULT) -> T:
    """Return the message of type `expected` that the payload holds.

    Args:
        payload: msgpack or JSON. Large arrays of the message are views of it.
        expected: the type of message that belongs on the key.
        encoding: the Zenoh encoding of the sample. Where it does not say, the first byte tells msgpack from JSON.
        limits: of messages.

    Raises:
        MessageError: whenever the payload is not a valid message of this type within the limits.
    """
    form = _form(encoding, expected)
    if not form:
        form = "json" if payload and payload[0] in _JSON_STARTS else "msgpack"
    most = limits.max_json_bytes if form == "json" else limits.max_bytes
    if len(payload) > most:
        raise MessageError("too_large", "", f"at most {most} bytes of {form}", f"{len(payload)} bytes")
    if form == "msgpack" and (message := read_columns(payload, expected, limits)) is not None:
        return message
    what = f"one map with the fields of {expected.__name__}"
    fields = read_json_map(payload, limits, what) if form == "json" else read_map(payload, limits, what)
    return build(fields, expected, limits)


def build(fields: dict[str, Any], expected: type[T], limits: Limits) -> T:
    """Return the message of fields as they were received, arrays as blocks or nested lists.

    Raises:
        MessageError: they do not make a valid message of this type within the limits.
    """
    labels = fields.get("labels")
    if isinstance(labels, list) and len(labels) > limits.max_labels:
        raise MessageError("too_large", "labels", f"at most {limits.max_labels} labels", f"{len(labels)} labels")
    _read_arrays(fields, expected, limits)
    return expected(**fields)


@lru_cache(256)
def _form(encoding: str, expected: type[Message]) -> str:
    """Return `msgpack`, `json`, or nothing when the encoding does not say. Refuse other types and versions."""
    if encoding in _UNDECLARED:
        return ""
    match = _ENCODING.fullmatch(encoding)
    form, kind, major = match.groups() if match else ("", "", "")
    if not match or kind not in {None, expected.__name__}:
        raise MessageError("wrong_type", "encoding", encoding_of(expected), show(encoding))
    if major is not None and int(major) != MAJOR:
        raise MessageError("unsupported_version", "encoding", encoding_of(expected, form=form), show(encoding))
    return str(form)


def read_map(payload: bytes, limits: Limits, what: str = "one map") -> dict[str, Any]:
    """Return the map that msgpack holds; `what` names it in errors.

    Raises:
        MessageError: it holds none, or one above a limit.
    """
    _check_msgpack(payload, limits)
    try:
        return _map_of(_msgpack.unpackb(payload, object_pairs_hook=_unique, max_str_len=limits.max_text), what)
    except MessageError:
        raise
    except ValueError as error:
        raise MessageError("malformed", "", "msgpack, its keys texts, its texts in UTF-8", show(str(error))) from None


def read_json_map(payload: bytes, limits: Limits, what: str = "one map") -> dict[str, Any]:
    """Return the map that JSON holds; as `read_map`."""
    _check_json(payload, limits)
    try:
        text = payload.decode()
        parsed = json.loads(text, object_pairs_hook=_unique, parse_constant=_refuse_constant, parse_int=_integer)
        return _map_of(parsed, what)
    except MessageError:
        raise
    except ValueError as error:
        raise MessageError("malformed", "", "JSON in UTF-8", show(str(error))) from None


def _map_of(fields: Any, what: str) -> dict[str, Any]:
    if not isinstance(fields, dict):
        raise MessageError("malformed", "", what, show(fields))
    return fields


def _unique(pairs: list[tuple[Any, Any]]) -> dict[str, Any]:
    """Return the pairs of a map, whose keys must be texts, each there once."""
    fields: dict[str, Any] = dict(pairs)
    if len(fields) != len(pairs):
        raise MessageError("malformed", "", "every key of a map once", f"{len(pairs) - len(fields)} again")
    for key in fields:
        if type(key) is not str:
            raise MessageError("malformed", "", "maps with texts as keys", f"a key of {show(key)}")
    return fields


def _refuse_constant(text: str) -> float:
    raise MessageError("malformed", "", "finite numbers (null for an unknown velocity)", text)


def _integer(text: str) -> int:
    if len(text) > _DIGITS:
        raise MessageError("malformed", "", "integers of at most 64 bits", show(text))
    return int(text)


def _read_arrays(fields: dict[str, Any], kind: type[Message], limits: Limits) -> None:
    """Replace blocks and lists by arrays in `fields`, also in the messages that they hold."""
    name = ""
    try:
        for name, description in kind.arrays.items():
            if fields.get(name) is not None:
                fields[name] = _read_array(fields[name], description, limits)
        for name, inner in kind.nested.items():
            if isinstance(fields.get(name), dict):
                _read_arrays(fields[name], inner, limits)
    except MessageError as error:
        raise error.under(name) from None


# Structure of a payload

_SCALAR, _LIST, _MAP, _TEXT, _BYTES, _BAD = range(6)

# Per first byte of a value: its kind, how many bytes of length follow, and the length that the byte itself carries
# (for scalars: how many bytes to skip).
_FIRST: Final[list[tuple[int, int, int]]] = [
    *[(_SCALAR, 0, 0)] * 0x80,
    *[(_MAP, 0, n) for n in range(16)],
    *[(_LIST, 0, n) for n in range(16)],
    *[(_TEXT, 0, n) for n in range(32)],
    *[(_SCALAR, 0, 0), (_BAD, 0, 0), (_SCALAR, 0, 0), (_SCALAR, 0, 0)],  # c0 nil, c1 never used, c2 false, c3 true
    *[(_BYTES, 1, 0), (_BYTES, 2, 0), (_BYTES, 4, 0)],  # c4..c6 bin
    *[(_BAD, 0, 0)] * 3,  # c7..c9 ext
    *[(_SCALAR, 0, 4), (_SCALAR, 0, 8)],  # ca, cb float
    *[(_SCALAR, 0, 1), (_SCALAR, 0, 2), (_SCALAR, 0, 4), (_SCALAR, 0, 8)] * 2,  # cc..d3 integers
    *[(_BAD, 0, 0)] * 5,  # d4..d8 fixext
    *[(_TEXT, 1, 0), (_TEXT, 2, 0), (_TEXT, 4, 0)],  # d9..db str
    *[(_LIST, 2, 0), (_LIST, 4, 0), (_MAP, 2, 0), (_MAP, 4, 0)],  # dc..df
    *[(_SCALAR, 0, 0)] * 0x20,
]


def _check_msgpack(payload: bytes, limits: Limits) -> None:
    """Walk a msgpack payload.

    Raises:
        MessageError: `malformed` when the payload is not exactly one value or holds an extension type; `too_large` when
            it is above a limit. Texts are not decoded and keys are not compared here.
    """
    size, position = len(payload), 0
    around: list[int] = []  # items to come in each list or map around the current one
    items = values = 1  # items to come in the current one; values declared so far in all
    while items or around:
        if not items:
            items = around.pop()
            continue
        items -= 1
        if position >= size:
            raise _truncated(size)
        kind, width, length = _FIRST[payload[position]]
        start = position
        position += 1
        if kind == _SCALAR:
            position += length
            continue
        if width:
            length = int.from_bytes(payload[position : position + width], "big")
            position += width
        if kind <= _MAP:  # a list or a map
            around.append(items)
            items = length if kind == _LIST else 2 * length
            values += items
            _check_declared(values, len(around), limits)
        else:
            if kind == _BAD or (kind == _TEXT and length > limits.max_text):
                raise _refused(kind, length, start, limits)
            position += length
    _check_end(position, size)


def _check_end(position: int, size: int) -> None:
    if position > size:
        raise _truncated(size)
    if position < size:
        raise MessageError("malformed", "", "one msgpack value", f"{size - position} bytes after its end")


def _check_declared(values: int, depth: int, limits: Limits) -> None:
    if values > limits.max_values:
        raise MessageError("too_large", "", f"at most {limits.max_values} values", f"at least {values}")
    if depth > limits.max_depth:
        raise MessageError("too_large", "", f"at most {limits.max_depth} levels of nesting", "more")


def _refused(kind: int, length: int, start: int, limits: Limits) -> MessageError:
    if kind == _BAD:
        return MessageError("malformed", "", "msgpack without extension types", f"one at byte {start}")
    return MessageError("too_large", "", f"texts of at most {limits.max_text} bytes", f"one of {length} bytes")


def _truncated(size: int) -> MessageError:
    return MessageError("malformed", "", "a whole msgpack value", f"one cut short after {size} bytes")


_PIECE: Final = 2**16
_BRACKETS: Final = bytes.maketrans(b"{}", b"[]")
_NOT_BRACKETS: Final = bytes(set(range(256)) - set(b"[]{}"))


def _check_json(payload: bytes, limits: Limits) -> None:
    """Check the nesting and the number of values of a JSON payload without parsing it.

    Raises:
        MessageError: `too_large` when there are too many values, `malformed` when brackets are too deep or unpaired.
    """
    # Without escaped characters, every second quote ends a text. Backslashes outside of texts are no JSON anyway.
    characters = payload.replace(b"\\\\", b"").replace(b'\\"', b"")
    parts, inside = [], 0
    for begin in range(0, len(characters), _PIECE):  # in pieces, which bounds the memory for their parts
        between = characters[begin : begin + _PIECE].split(b'"')
        parts.append(b"".join(between[inside::2]))
        inside = (inside + len(between) - 1) % 2
    outside = b"".join(parts)
    values = sum(map(outside.count, (b",", b":", b"[", b"{")))
    if values > limits.max_values:
        raise MessageError("too_large", "", f"at most {limits.max_values} values", f"about {values}")
    brackets = outside.translate(_BRACKETS, _NOT_BRACKETS)
    for _ in range(limits.max_depth):  # every round takes away the innermost level
        brackets = brackets.replace(b"[]", b"")
    if brackets:
        expected = f"brackets in pairs, at most {limits.max_depth} levels of them"
        raise MessageError("malformed", "", expected, "unpaired or deeper ones")


# Array blocks


def _read_array(value: object, description: Array, limits: Limits) -> Numeric:
    """Return a received block or nested list as an array of an allowed shape and of any number type.

    Raises:
        MessageError: with a path relative to the field, when the block is not well formed, or the shape is not as
            described or above a limit. The values are not checked here.
    """
    if isinstance(value, dict):
        return _read_block(value, description, limits)
    if not isinstance(value, list):
        raise invalid("", f"an array of shape {description.shape_described}", value)
    array = description.from_lists(value)
    _check_lengths(array.shape, description, limits)
    return array


def _check_lengths(shape: Sequence[int], description: Array, limits: Limits) -> None:
    for axis, letter in description.letters:
        most, length = limits.rows(letter), shape[axis]
        if length > most:
            what = "of dimension " + letter if axis else "rows"
            raise MessageError("too_large", "", f"at most {most} {what}", f"{length} {what}")


def _read_block(block: dict[str, Any], description: Array, limits: Limits) -> Numeric:
    for name in ("dtype", "shape", "data"):
        if block.get(name) is None:
            raise MessageError("missing_field", name, "a value", "nothing")
    name, shape, data = block["dtype"], block["shape"], block["data"]
    dtype = _NAMES.get(name) if isinstance(name, str) else None
    if dtype is None:
        raise invalid("dtype", f"one of {', '.join(DTYPES)} (little-endian)", name)
    if not isinstance(shape, list) or len(shape) != len(description.shape):
        raise invalid("shape", f"a list of {len(description.shape)} integers", shape)
    for i, length in enumerate(shape):
        if type(length) is not int or length < 0:
            raise invalid(f"shape[{i}]", "an integer of at least 0", length)
    description.check_shape(tuple(shape))
    if not isinstance(data, bytes | memoryview):
        raise invalid("data", "bytes (in JSON, arrays are nested lists)", data)
    size = prod(shape) * DTYPES[dtype]  # integers of Python do not overflow
    if size != len(data):
        raise invalid("data", f"{size} bytes, from dtype and shape", data)
    _check_lengths(shape, description, limits)
    return numeric.of_bytes(data, dtype, shape)


# Encoding

_SMALL_MAP: Final = 16
"""Fields from which on the head of a map has three bytes."""

_PLAIN: Final = frozenset({str, bytes, int, float, bool})  # what msgpack takes as it is
_AS_IS: Final = _PLAIN | {np.ndarray}


def _scalar(value: Any) -> Any:
    """Return a number or text of a subclass, such as numpy's float64, as its base type."""
    kinds: tuple[Any, ...] = (float, str, bytes, int)
    for kind in kinds:
        if isinstance(value, kind):
            return kind(value)
    raise TypeError(f"no plain value: {type(value).__name__}")


_encoder: Final = msgspec.msgpack.Encoder(enc_hook=_scalar)


def encode(message: Message, **others: Any) -> bytes:
    """Return the message as msgpack, arrays as blocks. Fields that are None are left out.

    Args:
        message: the message.
        others: values that are known to be valid; they replace fields of the message.
    """
    return b"".join(_parts(type(message), message.__dict__ | others if others else message.__dict__))


def _is_encoding(payload: bytes, message: Message) -> bool:
    """Return whether `encode` gives a payload for a message whose arrays were read from it."""
    at = 0
    for part in _parts(type(message), message.__dict__):
        if type(part) is not bytes:
            at += part.nbytes
        elif payload.startswith(part, at):
            at += len(part)
        else:
            return False
    return at == len(payload)


def _parts(kind: type[Message], values: dict[str, Any]) -> list[Any]:
    """Return the encoding in parts, bytes and the memory of arrays."""
    fields = {
        name: value if type(value) in _AS_IS else _plain(value, blocks=True)
        for name in kind.names
        if (value := values[name]) is not None
    }
    head = _head(len(fields))
    return [head, *_field_parts(kind, fields, len(head))]


def _field_parts(kind: type[Message], fields: dict[str, Any], offset: int) -> list[Any]:
    """Return fields, arrays and plain values, in parts; the first one begins at `offset`."""
    parts: list[Any] = []
    plain = {}
    for name, value in fields.items():
        if type(value) is not np.ndarray:
            plain[name] = value
            continue
        if plain:
            parts.append(_without_head(plain))
            offset += len(parts[-1])
            plain = {}
        head, length = _small_head(kind, name, value.shape)
        if not head:
            head = _large_head(name, kind.arrays[name].dtype, value.shape, offset)
            length += len(head)
        parts += head, value.data
        offset += length
    if plain:
        parts.append(_without_head(plain))
    return parts


def encode_columns(
    kind: type[Message], header: dict[str, Any], names: tuple[str, ...], columns: Numeric, others: dict[str, Any]
) -> bytes:
    """Return what `encode` gives for a message whose arrays lie one behind the other, without making the message.

    Args:
        kind: type of the message.
        header: the fields before the arrays, but for None.
        names: of the array fields in their order; they have numbers of 8 bytes, and no length but N may vary.
        columns: of float64, the numbers of all arrays as their bytes.
        others: the fields behind these arrays, likewise, and further arrays; a message in one as such or as its fields.
    """
    parts: list[Any] = [_head(len(header) + len(names) + len(others)), _without_head(header)]
    heads, places, end = _column_heads(kind, names, columns.size, (len(parts[0]) + len(parts[1])) % ALIGNMENT)
    parts += chain.from_iterable(zip(heads, map(columns.data.cast("B").__getitem__, places), strict=True))
    fields = {
        name: _plain(one, blocks=True) if isinstance(one, Message | tuple) else one for name, one in others.items()
    }
    return b"".join(parts + _field_parts(kind, fields, end))


def encoded(message: Message) -> bytes:
    """Return what `encode` gives, without making it again where the message came as these bytes."""
    kept: bytes | None = getattr(message, "encoded", None)
    return encode(message) if kept is None else kept


def _head(count: int) -> bytes:
    return bytes([0x80 | count]) if count < _SMALL_MAP else b"\xde" + count.to_bytes(2, "big")


def _without_head(fields: dict[str, Any]) -> bytes:
    """Return the fields of a map as msgpack, without its head."""
    return _encoder.encode(fields)[len(_head(len(fields))) :]


def encode_json(message: Message) -> bytes:
    """Return the message as one line of JSON: arrays as nested lists, the epoch as hexadecimal digits."""
    plain = _plain(message, blocks=False)
    return json.dumps(plain, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def _plain(value: Any, *, blocks: bool) -> Any:
    """Return a message as maps, lists and scalars, in a fixed order."""
    if isinstance(value, Message):
        fields: dict[str, Any] = {}
        for name, field in value.present():
            if type(field) in _PLAIN and blocks:
                fields[name] = field
            elif isinstance(field, np.ndarray):
                array = value.arrays[name]
                fields[name] = _block(field, array.dtype) if blocks else array.to_lists(field)
            else:
                fields[name] = _plain(field, blocks=blocks)
        return fields
    if isinstance(value, tuple | list):
        if blocks and _PLAIN.issuperset(map(type, value)):
            return value
        return [_plain(item, blocks=blocks) for item in value]
    if isinstance(value, dict):
        return {key: _plain(value[key], blocks=blocks) for key in sorted(value)}
    if isinstance(value, bytes) and not blocks:
        return value.hex()
    return value


def _block(array: Numeric, dtype: str) -> dict[str, Any]:
    """Return the block of an array of a number type."""
    return {"dtype": dtype, "shape": array.shape, "data": array.tobytes()}


def _large_head(name: str, dtype: str, shape: tuple[int, ...], offset: int) -> bytes:
    """Return the bytes before the data of a large array whose field begins at `offset`, with the padding."""
    before, after = _large_parts(name, dtype, shape)
    padding = -(offset + len(before) + 2 + len(after)) % ALIGNMENT
    return before + b"\xc4" + bytes((padding, *bytes(padding))) + after


# Messages have the same few shapes over and over.


@lru_cache(4096)
def _small_head(kind: type[Message], name: str, shape: tuple[int, ...]) -> tuple[bytes, int]:
    """Return the bytes before the data of an array, none if it is large, and the length of both."""
    dtype = kind.arrays[name].dtype
    size = prod(shape) * DTYPES[dtype]
    if size >= LARGE:
        return b"", size
    field: bytes = _msgpack.packb({name: {"dtype": dtype, "shape": shape, "data": bytes(size)}})
    return field[1 : len(field) - size], len(field) - 1


@lru_cache(1024)
def _column_heads(
    kind: type[Message], names: tuple[str, ...], size: int, offset: int
) -> tuple[tuple[bytes, ...], tuple[slice, ...], int]:
    """Return the bytes before the data of each array, the place of each in the data of all, and where the last ends.

    Args:
        kind: type of the message.
        names: of the arrays, whose numbers have 8 bytes; each has N rows, and no other length but by its description.
        size: how many numbers all have together.
        offset: where the first one begins, up to multiples of `ALIGNMENT`, as is the end.
    """
    rows = [tuple(map(int, kind.arrays[name].shape[1:])) for name in names]
    count = size // sum(map(prod, rows))
    places = [slice(begin, end) for begin, end in pairwise([0, *accumulate(8 * count * prod(row) for row in rows)])]
    heads = []
    for name, row, place in zip(names, rows, places, strict=True):
        head, _ = _small_head(kind, name, (count, *row))
        heads.append(head or _large_head(name, kind.arrays[name].dtype, (count, *row), offset))
        offset += len(heads[-1]) + place.stop - place.start
    return tuple(heads), tuple(places), offset


@lru_cache(1024)
def _large_parts(name: str, dtype: str, shape: tuple[int, ...]) -> tuple[bytes, bytes]:
    """Return the bytes before the padding of a large array, and those between it and the data."""
    pack, size = _msgpack.packb, prod(shape) * DTYPES[dtype]
    before = pack(name) + b"\x84" + b"".join(map(pack, ("dtype", dtype, "shape", shape, "pad")))
    return before, pack("data") + b"\xc6" + size.to_bytes(4, "big")


# Messages with columns

MOST_BYTES: Final = 2**16
"""Bytes of a payload up to which msgspec encodes the fields again to compare them."""

MOST_NUMBERS: Final = 2**13
"""Numbers of a message up to which the ranges of all columns are compared at once."""

_TypedDict: Any = TypedDict  # made of types that are not known before
_PARTS: Final[frozenset[type[Message]]] = frozenset({Pose, FieldOfView, Relocation})
"""Messages inside others that have numbers and required float64 arrays of fixed lengths and closed ranges alone."""
_BOUNDS: Final = ("ge", "gt", "le", "lt")
REFUSED: Final = (msgspec.MsgspecError, ValueError, TypeError, LookupError, RecursionError, struct.error)
"""Errors of a payload that is not valid, or not in this form."""


@cache
def _block_of(dtype: str, dimensions: int) -> Any:
    """Return the type of array blocks of a number type."""
    shape: Any = tuple[(int,) * dimensions]  # type: ignore[misc]  # made at run time
    fields = [("dtype", Literal[dtype]), ("shape", shape), ("data", memoryview)]
    return msgspec.defstruct("Block", fields, frozen=True, gc=False)


_ABSENT: Final = _block_of("f8", 1)("f8", None, b"")
"""Block of an array that is absent."""


@cache
def _struct_of(kind: type[Message]) -> Any:
    """Return the struct by which msgspec decodes a message: the fields of the model, its arrays as blocks."""
    hints = get_type_hints(kind, include_extras=True)
    hints |= {name: _number_of(kind, name) for name in _numbers_of(kind)}
    hints |= {name: _block_of(array.dtype, len(array.shape)) for name, array in kind.arrays.items()}
    hints |= {name: _struct_of(inner) for name, inner in kind.nested.items()}
    if "labels" in hints:
        hints["labels"] = Annotated[tuple[str, ...], msgspec.Meta(max_length=DEFAULT.max_labels)]
    fields: list[Any] = []
    for name in kind.names:
        if name in kind.names_required:
            fields.append((name, hints[name]))
        else:
            fields.append((name, hints[name] | UnsetType, _ABSENT if name in kind.arrays else UNSET))
    return msgspec.defstruct(kind.__name__, fields, kw_only=True, omit_defaults=True)


@cache
def _numbers_of(kind: type[Message]) -> tuple[str, ...]:
    """Return the required fields that are a number."""
    required = (name for name in kind.names if name in kind.names_required)
    return tuple(name for name in required if kind.model_fields[name].annotation in {int, float})


def _number_of(kind: type[Message], name: str) -> Any:
    """Return the type of a number with its bounds, which msgspec checks."""
    info = kind.model_fields[name]
    bounds = {key: getattr(one, key) for one in info.metadata for key in _BOUNDS if hasattr(one, key)}
    if info.annotation is float:
        bounds.setdefault("le", sys.float_info.max)
    return Annotated[info.annotation, msgspec.Meta(**bounds)]


@cache
def _scalars_of(kind: type[Message]) -> tuple[str, ...]:
    """Return the fields that pydantic checks: neither arrays nor messages, nor numbers."""
    others = {*kind.arrays, *kind.nested, *_numbers_of(kind)}
    return tuple(name for name in kind.names if name not in others)


@cache
def _checker_of(kind: type[Message]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return the validator of the scalars of a message, by the rules of its model."""
    hints = get_type_hints(kind, include_extras=True)
    scalars = {name: hints[name] for name in _scalars_of(kind)}
    return TypeAdapter(_TypedDict(kind.__name__, scalars, total=False)).validate_python


# Streams send the same names over and over.


@lru_cache(512)
def _checked_scalars(kind: type[Message], *values: Any) -> tuple[dict[str, Any], frozenset[str]]:
    """Return the scalars with the defaults of all fields, and the names of the given ones."""
    given = {name: value for name, value in zip(_scalars_of(kind), values, strict=True) if value is not UNSET}
    _need(None not in given.values())
    return kind.optional | _checker_of(kind)(given), frozenset((*given, *_numbers_of(kind)))


@lru_cache(1024)
def _part(kind: type[Message], numbers: tuple[Any, ...], *data: bytes) -> Message:
    """Return a message of numbers and of a few arrays of their bytes."""
    arrays = {}
    for (name, described), column in zip(kind.arrays.items(), data, strict=True):
        values = struct.unpack(f"<{described.shape[0]}d", column)
        _need(all(described.low <= one <= described.high for one in values))
        arrays[name] = np.frombuffer(column)
    for name, check in _checks_of(kind):
        check(arrays[name])
    message = kind.trusted(dict(zip(_numbers_of(kind), numbers, strict=True)) | arrays)
    message.check()
    return message


@cache
def _checks_of(kind: type[Message]) -> list[tuple[str, Callable[[Any], Any]]]:
    """Return further checks of arrays, by the name of the field."""
    found = [(name, one) for name in kind.arrays for one in kind.metadata_of(name)]
    checks: list[tuple[str, Any]] = [(name, one.func) for name, one in found if isinstance(one, AfterValidator)]
    return checks


class _Builder:
    """Builder of the messages of one type from their structs."""

    def __init__(self, kind: type[Message]) -> None:
        self._kind = kind
        self._numbers = _numbers_of(kind)
        self._scalars_in = _values_of(_scalars_of(kind))
        self._shapes_in = _values_of([f"{name}.shape" for name in kind.arrays])
        self._data_in = _values_of([f"{name}.data" for name in kind.arrays])
        self._checks = _checks_of(kind)
        self._nested = [(name, _Builder(inner)) for name, inner in kind.nested.items()]
        self._is_part = kind in _PARTS
        self._fixed = tuple(one.shape for one in kind.arrays.values())

    def message(self, fields: Any, limits: Limits) -> Message:
        """Return the message of a struct. Raises one of `REFUSED`: it is not valid, or not in this form."""
        kind = self._kind
        if self._is_part:
            _need(self._shapes_in(fields) == self._fixed)
            numbers = tuple([getattr(fields, name) for name in self._numbers])
            return _part(kind, numbers, *map(bytes, self._data_in(fields)))
        scalars, names = _checked_scalars(kind, *self._scalars_in(fields))
        values, given = scalars.copy(), set(names)
        for name in self._numbers:
            values[name] = getattr(fields, name)
        for name, inner in self._nested:
            if (part := getattr(fields, name)) is not UNSET:
                values[name] = inner.message(part, limits)
                given.add(name)
        if kind.arrays:
            data = self._data_in(fields)
            plan = _plan_of(kind, self._shapes_in(fields))
            _need([*map(len, data)] == plan.sizes)
            _need(all(length <= limits.rows(letter) for letter, length in plan.lengths.items()))
            for read in plan.readers:
                read(data, values)
            given |= plan.names
        for name, check in self._checks:
            if values[name] is not None:
                check(values[name])
        message = kind.of_valid(values, given)
        message.check()
        return message


_Read = Callable[[tuple[memoryview, ...], dict[str, Any]], None]
"""Adds columns, of the data of all arrays, to the values. Raises ValueError: a number is out of its range."""


def _columns(dtype: str, arrays: list[tuple[int, str, Array, tuple[int, ...]]]) -> _Read:
    """Return the reader of columns of one number type: one behind the other, those with unknown rows last."""
    arrays = sorted(arrays, key=lambda one: bool(one[2].unknown))
    sizes = [prod(shape) for *_, shape in arrays]
    places = [slice(begin, end) for begin, end in pairwise(accumulate(sizes, initial=0))]
    low = np.concatenate([np.full(size, _least(one[2]), dtype) for one, size in zip(arrays, sizes, strict=True)])
    high = np.concatenate([np.full(size, one[2].high, dtype) for one, size in zip(arrays, sizes, strict=True)])
    order = [at for at, *_ in arrays]
    columns = [
        (name, place, shape if len(shape) > 1 else None)
        for (_, name, _, shape), place in zip(arrays, places, strict=True)
    ]
    unknown = [(name, one, place) for (_, name, one, _), place in zip(arrays, places, strict=True) if one.unknown]
    known = unknown[0][2].start if unknown else len(low)

    def read(data: tuple[memoryview, ...], values: dict[str, Any]) -> None:
        numbers = np.frombuffer(b"".join([data[at] for at in order]), dtype)
        good = (numbers >= low) & (numbers <= high)
        for name, place, shape in columns:
            values[name] = numbers[place] if shape is None else numbers[place].reshape(shape)
        if not good[good.argmin()]:
            _need(bool(good[:known].all()))
            for name, one, place in unknown:
                absent = numeric.unknown(array := values[name], one)
                _need(bool((good[place].reshape(array.shape) | absent).all()))

    return read


def _column(at: int, name: str, described: Array, shape: tuple[int, ...]) -> _Read:
    """Return the reader of a single column, which is a view of the payload where it is large and aligned."""
    low, high, dtype = _least(described), described.high, described.dtype

    def read(data: tuple[memoryview, ...], values: dict[str, Any]) -> None:
        block = data[at]
        numbers = np.frombuffer(block if len(block) >= LARGE else bytes(block), dtype)
        if not numbers.flags.aligned:
            numbers = np.frombuffer(bytes(block), dtype)
        values[name] = array = numbers.reshape(shape)
        # Both are NaN where there is one, and comparisons with NaN are false.
        if not (numbers[numbers.argmin()] >= low and numbers[numbers.argmax()] <= high):
            _need(bool(described.unknown) and numeric.first_outside(array, described) is None)

    return read


class _Plan(NamedTuple):
    """Reading plan for the arrays of a message, by their shapes."""

    names: frozenset[str]
    """Arrays that are present."""
    sizes: list[int]
    """Bytes of each array, 0 of an absent one."""
    lengths: dict[str, int]
    """Symbolic dimensions."""
    readers: list[_Read]


@lru_cache(128)
def _plan_of(kind: type[Message], shapes: tuple[tuple[int, ...] | None, ...]) -> _Plan:
    """Return the plan for arrays of these shapes, None for an absent one. Raises ValueError: no message has them."""
    lengths: dict[str, int] = {}
    arrays, sizes = [], [0] * len(shapes)
    for at, ((name, described), shape) in enumerate(zip(kind.arrays.items(), shapes, strict=True)):
        if shape is None:
            continue
        for want, length in zip(described.shape, shape, strict=True):
            _need(0 < length == (want if isinstance(want, int) else lengths.setdefault(want, length)))
        arrays.append((at, name, described, shape))
        sizes[at] = DTYPES[described.dtype] * prod(shape)
    readers: list[_Read] = []
    many = sum(prod(shape) for *_, shape in arrays) > MOST_NUMBERS
    for dtype in dict.fromkeys(described.dtype for _, _, described, _ in arrays):
        alike = [one for one in arrays if one[2].dtype == dtype]
        readers += [_column(*one) for one in alike] if many or len(alike) == 1 else [_columns(dtype, alike)]
    return _Plan(frozenset(name for _, name, *_ in arrays), sizes, lengths, readers)


def _least(described: Array) -> Any:
    """Return the least number of a column."""
    low: Any = np.asarray(described.low, described.dtype)
    return (np.nextafter(low, np.inf, dtype=low.dtype) if described.above else low).item()


def _values_of(names: Sequence[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Return a getter of some attributes, as a tuple."""
    if len(names) > 1:
        return attrgetter(*names)
    return lambda fields: tuple([attrgetter(name)(fields) for name in names])


def _need(fact: bool) -> None:  # noqa: FBT001 - one condition, as after assert
    if not fact:
        raise ValueError


# Made on import: of two threads that ask msgspec for a decoder at once, one would use a type that is not complete.
DECODERS: Final[dict[type[Message], Callable[[bytes], Any]]] = {
    kind: msgspec.msgpack.Decoder(_struct_of(kind)).decode for kind in (Detections, Points, Tracks, Density)
}
"""Functions that decode the fields of messages with columns by their types alone; they raise what `REFUSED` names."""

_BUILDERS: Final = {kind: _Builder(kind) for kind in DECODERS}


def _encode(fields: Any) -> bytes:
    """Return a struct as msgpack, whose head msgspec makes of three bytes where the type has 16 fields."""
    again = _encoder.encode(fields)
    return again if again[:2] != b"\xde\0" or again[2] >= _SMALL_MAP else _head(again[2]) + again[3:]


def read_columns(payload: bytes, kind: type[T], limits: Limits) -> T | None:
    """Return the message with columns that msgspec decodes of a payload, else None: it is left to the models.

    Memory is bounded: msgspec builds what the types allow, tuples of a few elements and views of the payload. Of a map
    with a field twice it takes the last one, and it skips unknown fields. So the fields are encoded again. That gives
    as many bytes only if every field is there once, in any order: no other form of these types is shorter, but
    of floats. Where it would copy a large payload, `_is_encoding` compares the payload without them.
    """
    builder: Any = _BUILDERS.get(kind)
    if builder is None or not limits.allows_columns:
        return None
    try:
        fields = DECODERS[kind](payload)
        message: T = builder.message(fields, limits)
    except REFUSED:
        return None
    has_large = len(payload) >= LARGE and any(value.nbytes >= LARGE for value in _arrays_of(message))
    is_encoded = _is_encoding(payload, message) if has_large else _encode(fields) == payload
    # A float of `Tracks` may be written in fewer bytes, which a field that is there twice could make up for.
    if not is_encoded and (len(payload) > MOST_BYTES or kind is Tracks or len(_encode(fields)) != len(payload)):
        return None
    if is_encoded and isinstance(message, Detections):
        object.__setattr__(message, "encoded", payload)
    return message


def _arrays_of(message: Message) -> list[Numeric]:
    values = message.__dict__
    return [value for name in message.arrays if (value := values[name]) is not None]
