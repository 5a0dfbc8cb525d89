"""Messages to bytes: pure and deterministic, so equal messages give equal bytes. `codec` goes the other way."""

import json
from itertools import chain
from typing import Any, Final

import msgpack

from optipmb_schemas.arrays import ARRAY, Numeric, numeric
from optipmb_schemas.blocks import ALIGNMENT, block_of, column_heads, large_head, small_head
from optipmb_schemas.model import Message

_SMALL_MAP: Final = 16
"""Fields from which on the head of a map has three bytes."""

_BUFFER: Final = 2048
"""Bytes for fields that are no arrays, which it grows beyond. The default would be 256 KiB, new for each message."""

_SCALARS: Final = frozenset({str, bytes, int, float, bool})  # what msgpack takes as it is

_msgpack: Any = msgpack  # its type information is partial


def encode(message: Message, **others: Any) -> bytes:
    """Return the message as msgpack, arrays as blocks. Fields that are None are left out.

    Args:
        message: what is encoded.
        others: values that are known to be valid, in place of those of the message.
    """
    return numeric.joined(_parts(type(message), message.__dict__ | others if others else message.__dict__))


def is_encoding(payload: bytes, message: Message) -> bool:
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
    """Return the encoding in parts, bytes and arrays."""
    fields = [(name, value) for name in kind.names if (value := values[name]) is not None]
    packer = _msgpack.Packer(buf_size=_BUFFER)
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
    return parts


def encode_columns(
    kind: type[Message], header: dict[str, Any], names: tuple[str, ...], columns: Numeric, others: dict[str, Any]
) -> bytes:
    """Return what `encode` gives for a message whose arrays lie one behind the other, without making the message.

    Args:
        kind: type of the message.
        header: the fields before the arrays, without those that are None.
        names: of the array fields in their order; they have numbers of 8 bytes, and no length but N may vary.
        columns: of float64, the numbers of all arrays as their bytes.
        others: the fields behind the arrays, likewise; a message in one as its fields.
    """
    packer = _msgpack.Packer(buf_size=_BUFFER)
    parts: list[Any] = [packer.pack_map_header(len(header) + len(names) + len(others))]
    parts.append(_without_head(packer.pack(header), len(header)))
    heads, places = column_heads(kind, names, columns.size, (len(parts[0]) + len(parts[1])) % ALIGNMENT)
    parts += chain.from_iterable(zip(heads, map(numeric.memory_of(columns).__getitem__, places), strict=True))
    parts.append(_without_head(packer.pack(others), len(others)))
    return b"".join(parts)


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
