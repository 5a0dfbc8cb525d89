"""Messages to bytes and back: pure, total and bounded.

Total: `decode` returns a message or raises `MessageError`, whatever the bytes are. Bounded: sizes, counts and nesting
are checked before memory is taken for them. `encode` is deterministic: equal messages give equal bytes.
"""

import json
import re
from functools import lru_cache
from typing import Any, Final, TypeVar

import msgpack

from optipmb_schemas.arrays import ARRAY, numeric
from optipmb_schemas.blocks import block_of, large_head, read_array, small_head
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
from optipmb_schemas.errors import MessageError, show
from optipmb_schemas.limits import DEFAULT, Limits
from optipmb_schemas.messages import Density, Detections, Points, Tracks
from optipmb_schemas.model import Message
from optipmb_schemas.structure import Span, check_json, check_msgpack

try:
    from optipmb_schemas.compact import read_detections
except ModuleNotFoundError as missing:  # without numpy the models read every form
    if missing.name != "numpy":
        raise

    def read_detections(payload: bytes, limits: Limits) -> Detections | None:  # noqa: ARG001, D103  the other one's
        return None


T = TypeVar("T", bound=Message)

MESSAGES: Final[tuple[type[Message], ...]] = (
    Detections,
    Points,
    Tracks,
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

_SMALL_MAP: Final = 16
"""Fields from which on the head of a map has three bytes."""

_SCALARS: Final = frozenset({str, bytes, int, float, bool})  # what msgpack takes as it is

_msgpack: Any = msgpack  # its type information is partial


def encoding_of(message: Message | type[Message], *, form: str = "msgpack") -> str:
    """Return the Zenoh encoding of a message or type, as `application/msgpack;optipmb.Detections.v1`."""
    kind = message if isinstance(message, type) else type(message)
    return f"application/{form};optipmb.{kind.__name__}.v{MAJOR}"


def encode(message: Message, **others: Any) -> bytes:
    """Return the message as msgpack, arrays as blocks. Fields that are None are left out.

    Args:
        message: what is encoded.
        others: values that are known to be valid, in place of those of the message.
    """
    kind, values = type(message), message.__dict__ | others if others else message.__dict__
    fields = [(name, value) for name in kind.names if (value := values[name]) is not None]
    packer = _msgpack.Packer()
    parts: list[Any] = [packer.pack_map_header(len(fields))]
    offset, plain = len(parts[0]), {}
    for name, value in fields:
        if type(value) is not ARRAY:
            plain[name] = value if type(value) in _SCALARS else _plain(value, blocks=True)
            continue
        if plain:
            parts.append(_without_head(packer.pack(plain), len(plain)))
            offset += len(parts[-1])
            plain = {}
        head, length = small_head(kind, name, value.shape)
        if not head:
            head = large_head(name, kind.arrays[name].dtype, value.shape, offset)
            length += len(head)
        parts += head, value
        offset += length
    if plain:
        parts.append(_without_head(packer.pack(plain), len(plain)))
    return numeric.joined(parts)


def encoded(message: Message) -> bytes:
    """Return what `encode` gives, without making it again where the message came as these bytes."""
    kept: bytes | None = getattr(message, "encoded", None)
    return encode(message) if kept is None else kept


def _without_head(packed: bytes, count: int) -> bytes:
    """Return the fields of a packed map of so many without the head that says how many."""
    return packed[1 if count < _SMALL_MAP else 3 :]


def encode_json(message: Message) -> bytes:
    """Return the message as one line of JSON: arrays as nested lists, the epoch as hexadecimal digits."""
    plain = _plain(message, blocks=False)
    return json.dumps(plain, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def decode(payload: bytes, expected: type[T], *, encoding: str = "", limits: Limits = DEFAULT) -> T:
    """Return the message of type `expected` that the payload holds.

    Args:
        payload: msgpack or JSON. Large arrays of the message are views of it.
        expected: the type of message that belongs on the key.
        encoding: the Zenoh encoding of the sample. Where it does not say, the first byte tells msgpack from JSON.
        limits: what is accepted at most.

    Raises:
        MessageError: whenever the payload is not a valid message of this type within the limits.
    """
    form = _form(encoding, expected)
    if not form:
        form = "json" if payload and payload[0] in _JSON_STARTS else "msgpack"
    most = limits.max_json_bytes if form == "json" else limits.max_bytes
    if len(payload) > most:
        raise MessageError("too_large", "", f"at most {most} bytes of {form}", f"{len(payload)} bytes")
    message = read_detections(payload, limits) if expected is Detections and form == "msgpack" else None
    if isinstance(message, expected):
        return message
    fields = _parse_json(payload, limits) if form == "json" else _parse_msgpack(payload, limits)
    if not isinstance(fields, dict):
        raise MessageError("malformed", "", f"one map with the fields of {expected.__name__}", show(fields))
    return build(fields, expected, limits)


def build(fields: dict[str, Any], expected: type[T], limits: Limits) -> T:
    """Return the message of fields as they were received, arrays as blocks or nested lists.

    Raises:
        MessageError: whenever they are not those of a valid message of this type within the limits.
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


def _parse_msgpack(payload: bytes, limits: Limits) -> Any:
    large = check_msgpack(payload, limits)
    views = [memoryview(payload)[start:end] for _, start, end in large]
    try:
        return _msgpack.unpackb(
            _without(payload, large) if large else payload,
            object_pairs_hook=_unique,
            ext_hook=lambda _code, number: views[int.from_bytes(number, "big")],
            strict_map_key=True,
            max_str_len=limits.max_text,
            max_array_len=limits.max_values,
            max_map_len=limits.max_values,
        )
    except MessageError:
        raise
    except ValueError as error:
        raise MessageError("malformed", "", "msgpack, its keys texts, its texts in UTF-8", show(str(error))) from None


def _without(payload: bytes, large: list[Span]) -> bytes:
    """Return the payload with a numbered extension in place of every large byte string.

    So msgpack builds everything but the large strings. The payload itself holds no extensions: the check refuses them.
    """
    parts: list[bytes] = []
    end = 0
    for number, (header, _, after) in enumerate(large):
        parts += (payload[end:header], b"\xd6\x00", number.to_bytes(4, "big"))
        end = after
    return b"".join((*parts, payload[end:]))


def _parse_json(payload: bytes, limits: Limits) -> Any:
    check_json(payload, limits)
    try:
        text = payload.decode()
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_refuse_constant, parse_int=_integer)
    except MessageError:
        raise
    except ValueError as error:
        raise MessageError("malformed", "", "JSON in UTF-8", show(str(error))) from None


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
                fields[name] = read_array(fields[name], description, limits)
        for name, inner in kind.nested.items():
            if isinstance(fields.get(name), dict):
                _read_arrays(fields[name], inner, limits)
    except MessageError as error:
        raise error.under(name) from None


def _plain(value: Any, *, blocks: bool) -> Any:
    """Return a message as maps, lists and scalars, in a fixed order."""
    if isinstance(value, Message):
        fields: dict[str, Any] = {}
        for name, field in value.present():
            if type(field) in _SCALARS and blocks:
                fields[name] = field
            elif isinstance(field, ARRAY):
                array = value.arrays[name]
                fields[name] = block_of(field, array.dtype) if blocks else array.to_lists(field)
            else:
                fields[name] = _plain(field, blocks=blocks)
        return fields
    if isinstance(value, tuple | list):
        if blocks and _SCALARS.issuperset(map(type, value)):
            return value
        return [_plain(item, blocks=blocks) for item in value]
    if isinstance(value, dict):
        return {key: _plain(value[key], blocks=blocks) for key in sorted(value)}
    if isinstance(value, bytes) and not blocks:
        return value.hex()
    return value
