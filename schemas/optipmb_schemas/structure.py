"""Checks the structure of a payload before anything is built from it.

A msgpack header of five bytes can declare four thousand million items, and a byte per level can nest lists as deep as
the payload is long. So the bytes are walked once, without building anything: every declared item is there, none is too
deep, and there are not too many. What remains to be built afterwards is bounded by the limits.
"""

from typing import Final

from optipmb_schemas.errors import MessageError
from optipmb_schemas.limits import Limits

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


def check_msgpack(payload: bytes, limits: Limits) -> None:
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


def check_json(payload: bytes, limits: Limits) -> None:
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
