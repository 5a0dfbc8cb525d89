"""Array blocks of the wire: `{"dtype": "f8", "shape": [M, 3], "data": <bytes>}`, little-endian, row by row, no gaps.

Decoding a block makes a view of the received bytes where they are aligned and of the wanted number type, and one copy
otherwise. The encoder moves the data of a large block to a multiple of 8 bytes from the start of the message (with the
optional field `pad`), so that the receiver's view is aligned.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import accumulate, pairwise
from math import prod
from typing import Any, Final

import msgpack

from optipmb_schemas.arrays import Array, Numeric, numeric
from optipmb_schemas.errors import MessageError, invalid
from optipmb_schemas.limits import Limits
from optipmb_schemas.model import Message

DTYPES: Final = {name: int(name[1]) for name in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")}
"""Number types that a block may have, and their bytes. Numpy's spelling (`<f8`, `|u1`) is understood as well."""

LARGE: Final = 4096
"""Bytes from which on the encoder aligns a block's data."""

ALIGNMENT: Final = 8
"""Large blocks start at a multiple of this many bytes from the start of the message."""

_NAMES: Final = {f"{sign}{name}": name for name in DTYPES for sign in ("", "|" if DTYPES[name] == 1 else "<")}

_msgpack: Any = msgpack  # its type information is partial


def read_array(value: object, description: Array, limits: Limits) -> Numeric:
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


def block_of(array: Numeric, dtype: str) -> dict[str, Any]:
    """Return the block of an array of a number type."""
    return {"dtype": dtype, "shape": array.shape, "data": numeric.bytes_of(array)}


def large_head(name: str, dtype: str, shape: tuple[int, ...], offset: int) -> bytes:
    """Return all before the data of a large array, a field of a message that lies at `offset`: so they are aligned."""
    before, after = _large_head(name, dtype, shape)
    padding = -(offset + len(before) + 2 + len(after)) % ALIGNMENT
    return before + b"\xc4" + bytes((padding, *bytes(padding))) + after


# Messages have the same few shapes over and over.


@lru_cache(4096)
def small_head(kind: type[Message], name: str, shape: tuple[int, ...]) -> tuple[bytes, int]:
    """Return all before the data of an array of a message, nothing if it is large; and how many bytes both have."""
    dtype = kind.arrays[name].dtype
    size = prod(shape) * DTYPES[dtype]
    if size >= LARGE:
        return b"", size
    field: bytes = _msgpack.packb({name: {"dtype": dtype, "shape": shape, "data": bytes(size)}})
    return field[1 : len(field) - size], len(field) - 1


@lru_cache(1024)
def column_heads(
    kind: type[Message], names: tuple[str, ...], size: int, offset: int
) -> tuple[tuple[bytes, ...], tuple[slice, ...]]:
    """Return what stands before the data of each of some arrays, and where in these data each one lies, in bytes.

    Args:
        kind: type of the message.
        names: of the arrays, whose numbers have 8 bytes; each has N rows, and no other length but by its description.
        size: how many numbers all have together.
        offset: where the first one begins, up to multiples of `ALIGNMENT`.
    """
    rows = [tuple(map(int, kind.arrays[name].shape[1:])) for name in names]
    count = size // sum(map(prod, rows))
    places = [slice(begin, end) for begin, end in pairwise([0, *accumulate(8 * count * prod(row) for row in rows)])]
    heads = []
    for name, row, place in zip(names, rows, places, strict=True):
        head, _ = small_head(kind, name, (count, *row))
        heads.append(head or large_head(name, kind.arrays[name].dtype, (count, *row), offset))
        offset += len(heads[-1]) + place.stop - place.start
    return tuple(heads), tuple(places)


@lru_cache(1024)
def _large_head(name: str, dtype: str, shape: tuple[int, ...]) -> tuple[bytes, bytes]:
    """Return what stands before the padding of a large array, and what between it and the data."""
    pack, size = _msgpack.packb, prod(shape) * DTYPES[dtype]
    before = pack(name) + b"\x84" + b"".join(map(pack, ("dtype", dtype, "shape", shape, "pad")))
    return before, pack("data") + b"\xc6" + size.to_bytes(4, "big")
