"""Bytes to messages, whose types and versions are named here: pure, total and bounded. `encoder` goes the other way.

Total: `decode` returns a message or raises `MessageError`, whatever the bytes are. Bounded: sizes, counts and nesting
are checked before memory is taken for them.
"""

import json
import re
from functools import lru_cache
from typing import Any, Final, TypeVar

import msgpack

from optipmb_schemas.blocks import read_array
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
from optipmb_schemas.structure import check_json, check_msgpack

try:
    from optipmb_schemas.decoder import read
except ModuleNotFoundError as missing:  # without numpy the models read every form
    if missing.name != "numpy":
        raise

    def read(payload: bytes, kind: type["T"], limits: Limits) -> "T | None":  # noqa: ARG001, D103  in place of `decoder.read`
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
    if form == "msgpack" and (message := read(payload, expected, limits)) is not None:
        return message
    what = f"one map with the fields of {expected.__name__}"
    fields = _map_of(_parse_json(payload, limits), what) if form == "json" else read_map(payload, limits, what)
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


def read_map(payload: bytes, limits: Limits, what: str = "one map") -> dict[str, Any]:
    """Return the map that msgpack holds; `what` names it in errors.

    Raises:
        MessageError: it holds none, or one above a limit.
    """
    check_msgpack(payload, limits)
    try:
        return _map_of(_msgpack.unpackb(payload, object_pairs_hook=_unique, max_str_len=limits.max_text), what)
    except MessageError:
        raise
    except ValueError as error:
        raise MessageError("malformed", "", "msgpack, its keys texts, its texts in UTF-8", show(str(error))) from None


def _parse_json(payload: bytes, limits: Limits) -> Any:
    check_json(payload, limits)
    try:
        text = payload.decode()
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_refuse_constant, parse_int=_integer)
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
                fields[name] = read_array(fields[name], description, limits)
        for name, inner in kind.nested.items():
            if isinstance(fields.get(name), dict):
                _read_arrays(fields[name], inner, limits)
    except MessageError as error:
        raise error.under(name) from None
