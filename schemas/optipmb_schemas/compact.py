"""Detections in their usual form, read without the steps that other forms need; all else is left to the models.

The usual form has columns of little-endian float64 and int64 and known fields only, each once, whether in msgpack
(`read_detections`) or in protobuf (`protobuf.convert`, which brings its fields to `checked`). Nothing is refused here.
What is not plainly a valid message in this form gives None: the walk and the models read it then, or say what is wrong
with it. So there is one set of rules and one set of errors, and tests hold what is accepted here equal to the models.

Most payloads have the layout of one that was read before (`layout`): of those only the values are looked at.

The bounds are those of `structure`. A payload is short enough here that whatever is built from it is small, every value
in it is looked at, and so it holds no more values, no deeper nesting and no longer texts than the limits allow.
"""

import sys
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from math import prod
from operator import itemgetter
from struct import unpack
from typing import Any, Final, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray

from optipmb_schemas.arrays import unit_quaternion
from optipmb_schemas.blocks import ALIGNMENT
from optipmb_schemas.encoder import encode
from optipmb_schemas.fields import check_labels, check_stream
from optipmb_schemas.layout import Layout, layout_of, stream_begin, stream_end
from optipmb_schemas.limits import Limits
from optipmb_schemas.messages import INT64, Detections, FieldOfView, Pose
from optipmb_schemas.model import Message

MOST: Final = 2**16
"""Bytes of a payload that is read in this way; of a longer one the walk is a small part."""

DEEPEST: Final = 4
"""Levels of lists and maps: message, pose, block, shape."""

_EPOCH: Final = 16
_TEXT: Final = 64
_LABELS: Final = 256
_KNOWN: Final = frozenset(Detections.model_fields) - {"position_covariance"}
_INNER: Final[dict[str, Any]] = {"pose": Pose, "field_of_view": FieldOfView}
_REQUIRED: Final = frozenset(name for name, field in Detections.model_fields.items() if field.is_required())
_BLOCK: Final = frozenset({"dtype", "shape", "data"})
_PADDED: Final = _BLOCK | {"pad"}
_DTYPES: Final = {"i8": frozenset({"i8", "<i8"}), "f8": frozenset({"f8", "<f8"})}
_COLUMNS: Final = (("center", 3), ("size", 3), ("yaw", 1), ("score", 1), ("velocity", 2))
_PAD: Final = b"\xa3pad\xc4"
_LITTLE: Final = sys.byteorder == "little"
_FRAMES: Final = frozenset({"world", "sensor"})
_NUMBERS: Final[dict[type[Message], tuple[tuple[str, int, float, float], ...]]] = {
    kind: tuple((name, int(one.shape[0]), one.low, one.high) for name, one in kind.arrays.items())
    for kind in (Pose, FieldOfView)
}

MOST_LENGTHS: Final = 256
"""Lengths of payloads of which layouts are remembered; a layout takes about two kilobytes."""

MOST_LAYOUTS: Final = 4
"""Layouts of one length."""

MOST_CACHED: Final = 512
"""Detections up to which the bounds of all their numbers are remembered, by their number; for so many 80 kilobytes."""

T = TypeVar("T", Pose, FieldOfView)
_BytesOf = Callable[[dict[str, Any]], tuple[bytes, ...]]
_msgpack: Any = msgpack  # its type information is partial


@dataclass(frozen=True, slots=True)
class _Canonical:
    """When a payload of a layout is what `encode` gives for its message, where one payload of the layout is.

    The form of three values depends on them: that of the stream, behind which large blocks are padded to a multiple of
    `ALIGNMENT`, and of the two integers, which msgpack writes in as few bytes as it can.

    Attributes:
        multiple: of which the end of the stream may be moved; 1 where nothing is padded.
        remainder: of that end.
        seq: smallest integer that takes as many bytes.
        stamp_ns: the same.
    """

    multiple: int
    remainder: int
    seq: int
    stamp_ns: int

    @classmethod
    def of(cls, payload: bytes, start: int, message: Detections) -> "_Canonical":
        """Return when it is so, from a payload that is; its stream ends at `start`."""
        multiple = ALIGNMENT if _PAD in payload else 1
        return cls(multiple, start % multiple, _least(message.seq), _least(message.stamp_ns))

    def holds(self, stream: bytes, start: int, message: Detections) -> bool:
        """Whether it is so for another payload of the layout; its stream ends at `start`."""
        return (
            message.seq >= self.seq
            and message.stamp_ns >= self.stamp_ns
            and start % self.multiple == self.remainder
            and start - len(stream) == stream_begin(len(stream))
        )


@dataclass(frozen=True, slots=True)
class _Known:
    """A layout of valid payloads, and what is the same in all of them.

    Attributes:
        layout: where the values lie.
        limits: within which these payloads are.
        fields: all fields, with the values of those that are in the layout itself.
        given: names of the fields that are there.
        inner: names of the fields that are maps.
        count: number of detections.
        canonical: where a payload of the layout is what `encode` gives for its message; None: nowhere.
    """

    layout: Layout
    limits: Limits
    fields: dict[str, Any]
    given: frozenset[str]
    inner: tuple[str, ...]
    count: int
    canonical: _Canonical | None


_known: OrderedDict[int, list[_Known]] = OrderedDict()
"""By the number of bytes behind the stream; empty when one such payload was read, for the second one makes a layout."""


def read_detections(payload: bytes, limits: Limits) -> Detections | None:
    """Return the message of a payload in this form; None when it is in another, or not valid."""
    if len(payload) > MOST or len(payload) > limits.max_values or limits.max_depth < DEEPEST or not _LITTLE:
        return None
    found = stream_end(payload)
    try:
        if found is not None:
            for known in _known.get(len(payload) - found[1], ()):
                if known.limits is limits and (values := known.layout.values(payload, found[1])) is not None:
                    message = _read_known(known, found[0], values)
                    if known.canonical and known.canonical.holds(*found, message):
                        object.__setattr__(message, "encoded", payload)
                    return message
        message = _read(payload, limits)
        if found is not None:
            _remember(payload, found[1], message, limits)
    except (ValueError, TypeError, LookupError):
        return None
    return message


def _read_known(known: _Known, stream: bytes, values: tuple[Any, ...]) -> Detections:
    """Return the message of values in a known layout.

    Raises:
        ValueError: they are not valid.
    """
    fields = known.fields | dict(zip(known.layout.names, values, strict=True))
    if len(stream) > known.limits.max_text or fields["seq"] > INT64 or fields["stamp_ns"] > INT64:
        raise ValueError
    fields["stream"] = _stream_of(stream)
    for name in known.inner:
        fields[name] = checked_part(_INNER[name], partial(_taken, fields, name))
    _read_columns(fields, known.count)
    return Detections.of_valid(fields, set(known.given))


def _least(number: int) -> int:
    """Return the smallest integer that msgpack writes in as many bytes as one of at least 128."""
    return next(least for least in (1 << 32, 1 << 16, 1 << 8, 1 << 7) if number >= least)


def _taken(fields: dict[str, Any], name: str, part: str, _length: int) -> bytes:
    """Take the bytes of an array inside a field out of the values."""
    data: bytes = fields.pop(f"{name}.{part}")
    return data


def _remember(payload: bytes, start: int, message: Detections, limits: Limits) -> None:
    """Remember the layout of a valid payload when a second one of its length has come."""
    length = len(payload) - start
    alike = _known.get(length)
    if alike is None:
        _known[length] = []
        if len(_known) > MOST_LENGTHS:
            _known.popitem(last=False)
        return
    if (layout := layout_of(payload, start)) is None:
        return
    names = {name.partition(".")[0] for name in layout.names}
    fields = {name: None if name in names else value for name, value in message.__dict__.items()}
    known = _Known(
        layout,
        limits,
        fields,
        frozenset(message.model_fields_set),
        tuple(name for name in _INNER if name in names),
        len(message.label),
        _Canonical.of(payload, start, message) if encode(message) == payload else None,
    )
    alike.append(known)
    del alike[:-MOST_LAYOUTS]
    _known.move_to_end(length)


def _read(payload: bytes, limits: Limits) -> Detections:
    pairs = _msgpack.unpackb(
        payload,
        object_pairs_hook=tuple,
        ext_hook=_refuse,
        max_str_len=limits.max_text,
        max_array_len=_LABELS,
        max_map_len=len(_KNOWN),
    )
    fields = _once(pairs)
    for name, kind in _INNER.items():
        if fields.get(name) is not None:
            fields[name] = _part(fields[name], kind)
    return checked(fields, dict(fields["label"])["shape"][0], _data, limits)


def checked(
    fields: dict[str, Any], count: int, data: Callable[[Any, str, list[int]], bytes], limits: Limits
) -> Detections:
    """Return the message of its fields, whose columns are still in the form in which they came.

    Args:
        fields: the values by name, pose and field of view as models.
        count: number of detections.
        data: returns the bytes of a column that has a number type and a shape; ValueError if it has others.
        limits: what is accepted at most.

    Raises:
        ValueError, TypeError, LookupError: it is for the models.
    """
    labels = fields["labels"]
    _need(_REQUIRED <= fields.keys() <= _KNOWN)
    _need(type(labels) is list and type(count) is int and 0 < count <= limits.max_detections)
    for name in ("seq", "stamp_ns"):
        _need(type(fields[name]) is int and 0 <= fields[name] <= INT64)
    _need(type(fields["epoch"]) is bytes and len(fields["epoch"]) == _EPOCH)
    _need(type(fields["stream"]) is str and fields["frame"] in _FRAMES)
    _need(fields.get("has_points") is None or type(fields["has_points"]) is bool)
    _need(fields.get("pose") is not None or fields["frame"] == "world")
    _stream(fields["stream"])
    _need(len(labels) <= limits.max_labels)
    fields["labels"] = _labels(tuple(labels))
    fields["label"] = data(fields["label"], "i8", [count])
    for name, width in _COLUMNS:
        if fields.get(name) is not None:
            fields[name] = data(fields[name], "f8", [count, width] if width > 1 else [count])
    _read_columns(fields, count)
    return Detections.trusted(fields)


def checked_part(kind: type[T], data: Callable[[str, int], bytes]) -> T:
    """Return the message inside whose numbers `data` returns, given the name and the length of each of its arrays.

    Raises:
        ValueError, TypeError, LookupError: it is for the models.
    """
    part: T = _part_of(kind, *[data(name, length) for name, length, _, _ in _NUMBERS[kind]])
    return part


@lru_cache(1024)
def _part_of(kind: type[Pose | FieldOfView], *parts: bytes) -> Any:
    """Return the message inside of the bytes of its arrays; most sensors have the same in every message."""
    arrays = {}
    for (name, length, low, high), numbers in zip(_NUMBERS[kind], parts, strict=True):
        _need(all(low <= value <= high for value in unpack(f"<{length}d", numbers)))
        arrays[name] = np.frombuffer(numbers, np.float64)
    if kind is Pose:
        unit_quaternion(arrays["quaternion"])
    part = kind.trusted(arrays)
    part.check()
    return part


def _read_columns(fields: dict[str, Any], count: int) -> None:
    """Replace the bytes of columns by arrays, those of numbers in one buffer, and check their ranges together.

    Raises:
        ValueError: a number is out of its range.
    """
    label = np.frombuffer(fields["label"], np.uint64)
    _need(int(label[label.argmax()]) < len(fields["labels"]))  # a negative one is larger than any
    fields["label"] = label.view(np.int64)
    columns_of = _columns if count <= MOST_CACHED else _columns.__wrapped__
    bytes_of, columns, low, high = columns_of(count, velocity=fields.get("velocity") is not None)
    numbers = np.frombuffer(b"".join(bytes_of(fields)))
    good = (numbers >= low) & (numbers <= high)
    if not good[good.argmin()]:
        known = 8 * count  # numbers of other columns than the velocity, of which a row may be NaN
        unknown = np.isnan(numbers[known:].reshape(-1, 2)).all(axis=1, keepdims=True)
        _need(bool(good[:known].all() and (good[known:].reshape(-1, 2) | unknown).all()))
    for name, place, width in columns:
        fields[name] = numbers[place] if width == 1 else numbers[place].reshape(count, width)


@lru_cache(64)
def _columns(
    count: int, *, velocity: bool
) -> tuple[_BytesOf, tuple[tuple[str, slice, int], ...], NDArray[np.float64], NDArray[np.float64]]:
    """Return how the columns of so many detections lie in one buffer, and what each number may be.

    First is what takes them out of the fields, then the name, the place and the width of each, then the bounds.
    """
    columns, begin, low, high = [], 0, [], []
    for name, width in _COLUMNS if velocity else _COLUMNS[:-1]:
        size, one = count * width, Detections.arrays[name]
        columns.append((name, slice(begin, begin + size), width))
        begin += size
        low.append(np.full(size, np.nextafter(one.low, np.inf) if one.above else one.low))
        high.append(np.full(size, one.high))
    bytes_of: _BytesOf = itemgetter(*(name for name, _, _ in columns))
    return bytes_of, tuple(columns), np.concatenate(low), np.concatenate(high)


def _part(pairs: Any, kind: type[T]) -> T:
    blocks = _once(pairs)
    _need(len(blocks) == len(_NUMBERS[kind]))
    return checked_part(kind, lambda name, length: _data(blocks[name], "f8", [length]))


def _data(pairs: Any, dtype: str, shape: list[int]) -> bytes:
    """Return the bytes of a block of a type and shape."""
    block: dict[str, Any] = dict(pairs)
    data: bytes = block["data"]
    if (
        type(pairs) is tuple
        and len(block) == len(pairs)
        and (block.keys() == _BLOCK or (block.keys() == _PADDED and type(block["pad"]) is bytes))
        and block["dtype"] in _DTYPES[dtype]
        and block["shape"] == shape
        and [*map(type, block["shape"])] == [*map(type, shape)]  # 1.0 and true equal 1
        and type(data) is bytes
        and len(data) == 8 * prod(shape)
    ):
        return data
    raise ValueError


# Streams send the same names over and over.


@lru_cache(4096)
def _stream(name: str) -> str:
    return check_stream(name)


@lru_cache(4096)
def _stream_of(name: bytes) -> str:
    return check_stream(name.decode())


@lru_cache(64)
def _labels(labels: tuple[str, ...]) -> tuple[str, ...]:
    _need(all(type(label) is str and 0 < len(label) <= _TEXT for label in labels) and len(labels) <= _LABELS)
    return check_labels(labels)


def _once(pairs: Any) -> dict[str, Any]:
    """Return the fields of a map, each there once."""
    fields: dict[str, Any] = dict(pairs)
    _need(type(pairs) is tuple and len(fields) == len(pairs))
    return fields


def _need(fact: bool) -> None:  # noqa: FBT001 - one condition, as after assert
    if not fact:
        raise ValueError


def _refuse(code: int, _data: bytes) -> None:
    raise ValueError(code)
