"""Where the values lie in payloads that differ in nothing else.

A detector sends one form of message over and over: with as many detections as before, all that is no value (names,
number types, shapes, labels) is the same bytes at the same places. A layout is made of one msgpack payload that was
read and found valid. A payload of its length with the same bytes there is the same map with other values, because
msgpack is read from left to right and says before each value how long it is. So nothing but the values has to be
checked. The stream, in front, may be another one.
"""

from dataclasses import dataclass
from struct import Struct
from typing import Any, Final

import msgpack

_msgpack: Any = msgpack  # its type information is partial

_STREAM: Final = b"\xa6stream"
_AT: Final = 1 + len(_STREAM)
_SHORT: Final = range(0xA0, 0xC0)
_LONG: Final = 0xD9
_SMALL_MAPS: Final = range(0x80, 0x90)
_WHOLE: Final = {0xCC: "B", 0xCD: "H", 0xCE: "I", 0xCF: "Q"}
"""Unsigned integers by their first byte, and how `struct` reads what follows."""

_EPOCH: Final = 16


@dataclass(frozen=True, slots=True)
class Layout:
    """What lies where, behind the stream; see `layout_of`.

    Attributes:
        form: divides a payload into the bytes that are the same in all and, by turns, the values between them.
        same: the former.
        names: of the values: those of fields, `pose.translation` for one inside a field.
    """

    form: Struct
    same: tuple[bytes, ...]
    names: tuple[str, ...]

    def values(self, payload: bytes, start: int) -> tuple[Any, ...] | None:
        """Return the values by `names`, integers and bytes; None when the payload has another layout.

        Args:
            payload: of which everything from `start` on has the length of the layout.
            start: where the stream ends.
        """
        parts = self.form.unpack_from(payload, start)
        return parts[1::2] if payload[0] == self.same[-1][0] and parts[::2] == self.same[:-1] else None


def stream_end(payload: bytes) -> tuple[bytes, int] | None:
    """Return the stream, not checked, of a payload that starts with it, and where it ends; None where none does."""
    if payload[1:_AT] != _STREAM or len(payload) < _AT + 2:
        return None
    first = payload[_AT]
    begin, length = (_AT + 1, first - _SHORT[0]) if first in _SHORT else (_AT + 2, payload[_AT + 1])
    if begin == _AT + 2 and first != _LONG:
        return None
    return payload[begin : begin + length], begin + length


def stream_begin(length: int) -> int:
    """Return where a stream of so many bytes begins in a payload that starts with it, as msgpack writes it."""
    return _AT + (1 if length < len(_SHORT) else 2)


def layout_of(payload: bytes, start: int) -> Layout | None:
    """Return the layout of a valid payload; None where it is not of the kind that comes again.

    Args:
        payload: a map with the stream in front, then an epoch, integers, blocks, and maps of blocks.
        start: where the stream ends.
    """
    if payload[0] not in _SMALL_MAPS:
        return None
    reader = _msgpack.Unpacker(strict_map_key=False, max_buffer_size=len(payload))
    reader.feed(payload)
    spans: list[tuple[tuple[str, ...], int, int, str]] = []
    reader.read_map_header()
    for _ in range(payload[0] - _SMALL_MAPS[0]):
        name = reader.unpack()
        if not _find(reader, payload, (name,), spans):
            return None
    form, same, at = [">"], [], start
    for _, begin, end, kind in spans:
        form.append(f"{begin - at}s{kind or f'{end - begin}s'}")
        same.append(payload[at:begin])
        at = end
    form.append(f"{len(payload) - at}s")
    same.append(payload[at:])
    return Layout(Struct("".join(form)), (*same, payload[:1]), tuple(".".join(path) for path, *_ in spans))


def _find(
    reader: Any, payload: bytes, path: tuple[str, ...], spans: list[tuple[tuple[str, ...], int, int, str]]
) -> bool:
    """Add where the values of a field lie; False when it has a form that a layout does not have."""
    begin = reader.tell()
    if path == ("epoch",):
        reader.skip()
        spans.append((path, reader.tell() - _EPOCH, reader.tell(), ""))
    elif path in {("seq",), ("stamp_ns",)}:
        reader.skip()
        kind = _WHOLE.get(payload[begin])
        if kind is None:
            return False
        spans.append((path, begin + 1, reader.tell(), kind))
    elif payload[begin] in _SMALL_MAPS:
        for _ in range(reader.read_map_header()):
            name = reader.unpack()
            if name != "data":
                if not _find(reader, payload, (*path, name), spans):
                    return False
                continue
            length = len(reader.unpack())
            spans.append((path, reader.tell() - length, reader.tell(), ""))
    else:
        reader.skip()
    return True
