"""Messages to bytes: pure and deterministic, so equal messages give equal bytes. `codec` goes the other way."""

import json
from functools import lru_cache
from itertools import chain
from operator import attrgetter
from typing import Any, Final

import msgpack

from optipmb_schemas.arrays import ARRAY, Numeric, numeric
from optipmb_schemas.blocks import ALIGNMENT, block_of, column_heads, heads_of
from optipmb_schemas.model import Message

_SMALL_MAP: Final = 16
"""Fields from which on the head of a map has three bytes."""

_BUFFER: Final = 2048
"""Bytes for fields that are no arrays, which it grows beyond. The default would be 256 KiB, new for each message."""

_SCALARS: Final = frozenset({str, bytes, int, float, bool})  # what msgpack takes as it is

_msgpack: Any = msgpack  # its type information is partial
_shape: Final = attrgetter("shape")


def encode(message: Message, **others: Any) -> bytes:
    """Return the message as msgpack, arrays as blocks. Fields that are None are left out.

    Args:
        message: what is encoded.
        others: values that are known to be valid, in place of those of the message.
    """
    kind, values = type(message), message.__dict__ | others if others else message.__dict__
    value_of = values.__getitem__
    count, runs = _runs(kind, tuple(map(type, map(value_of, kind.names))))
    packer = _msgpack.Packer(buf_size=_BUFFER)
    parts: list[Any] = [packer.pack_map_header(count)]
    offset = len(parts[0])
    for plain, nested, arrays in runs:
        if plain:
            fields = dict(zip(plain, map(value_of, plain), strict=True))
            for name in nested:
                fields[name] = _plain(fields[name], blocks=True)
            parts.append(_without_head(packer.pack(fields), len(fields)))
            offset += len(parts[-1])
        if arrays:
            columns = [*map(value_of, arrays)]
            heads, length = heads_of(kind, arrays, tuple(map(_shape, columns)), offset % ALIGNMENT)
            parts += chain.from_iterable(zip(heads, columns, strict=True))
            offset += length
    return numeric.joined(parts)


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


@lru_cache(1024)
def _runs(
    kind: type[Message], types: tuple[type, ...]
) -> tuple[int, tuple[tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]], ...]]:
    """Return how many fields are there and in which runs, of the types of all values of a message.

    A run: names of fields that are no arrays, those of them that hold others, and names of the arrays behind them.
    """
    there = [(name, one) for name, one in zip(kind.names, types, strict=True) if one is not type(None)]
    runs: list[tuple[list[str], list[str], list[str]]] = []
    for name, one in there:
        if not runs or (one is not ARRAY and runs[-1][2]):
            runs.append(([], [], []))
        plain, nested, arrays = runs[-1]
        (arrays if one is ARRAY else plain).append(name)
        if one is not ARRAY and one not in _SCALARS:
            nested.append(name)
    return len(there), tuple([(tuple(plain), tuple(nested), tuple(arrays)) for plain, nested, arrays in runs])


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
        fields: dict[str, Any] = dict(value.present())
        if blocks and _SCALARS.issuperset(map(type, fields.values())):
            return fields
        for name, field in fields.items():
            if isinstance(field, ARRAY):
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
    return value.hex() if isinstance(value, bytes) and not blocks else value
