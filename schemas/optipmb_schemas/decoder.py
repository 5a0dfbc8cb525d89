"""Decode messages with columns by msgspec, by types that come from the pydantic models.

Nothing is refused here. A payload that is not plainly a valid message gives None; `codec` then reads it by the models
or names the error. So there is one set of rules and one set of errors. Tests hold the messages of both ways equal.

Memory is bounded: msgspec builds what the types allow, lists of a few elements and views of the payload. Of a map with
a field twice it takes the last one, and it skips unknown fields. So the fields are encoded again, and the payload must
be those bytes: by msgspec in the order in which they came, or, where that would copy a large payload, by `is_encoding`.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from math import prod
from struct import unpack
from typing import Annotated, Any, Final, TypeVar, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, TypeAdapter
from typing_extensions import TypedDict

from optipmb_schemas.arrays import Array, numeric
from optipmb_schemas.blocks import DTYPES, LARGE
from optipmb_schemas.encoder import is_encoding
from optipmb_schemas.limits import DEFAULT, Limits
from optipmb_schemas.messages import Density, Detections, FieldOfView, Points, Pose, Tracks
from optipmb_schemas.model import Message

T = TypeVar("T", bound=Message)

MOST_BYTES: Final = 2**16
"""Bytes of a payload up to which msgspec encodes the fields again to compare them."""

MOST_NUMBERS: Final = 2**13
"""Numbers of a message up to which the ranges of all columns are compared at once."""

_MOST_TEXT: Final = 2000
_MOST_VALUES: Final = 1000
_MOST_DEPTH: Final = 4
"""Bytes of a text, values and levels of lists and maps that no valid message in this form exceeds."""

_TypedDict: Any = TypedDict  # made of types that are not known before
_PARTS: Final[frozenset[type[Message]]] = frozenset({Pose, FieldOfView})
"""Messages inside others that have required float64 arrays of fixed lengths and closed ranges alone."""
_LITTLE: Final = sys.byteorder == "little"
REFUSED: Final = (msgspec.MsgspecError, ValueError, TypeError, LookupError, RecursionError)
"""Errors of `checked`, and of msgspec."""


class Block(msgspec.Struct, gc=False):
    """Array block as it was received."""

    dtype: str
    shape: Annotated[list[int], msgspec.Meta(max_length=4)]
    data: memoryview


@dataclass(frozen=True, slots=True)
class _Form:
    """How messages with some fields are read.

    Attributes:
        scalars, arrays, nested: names of the fields, by what they hold.
        checks: further checks of arrays.
        in_order: whether the fields are in the order in which they are encoded.
    """

    scalars: tuple[str, ...]
    arrays: tuple[str, ...]
    nested: tuple[str, ...]
    checks: tuple[tuple[str, Callable[[Any], Any]], ...]
    in_order: bool


@lru_cache(256)
def _form_of(kind: type[Message], names: tuple[str, ...]) -> _Form:
    """Return how messages with these fields are read. Raises ValueError: one is missing or unknown."""
    _need(kind.names_required <= set(names) <= set(kind.names))
    arrays = tuple(name for name in names if name in kind.arrays)
    nested = tuple(name for name in names if name in kind.nested)
    checks: list[tuple[str, Any]] = [
        (name, one.func) for name in arrays for one in kind.metadata_of(name) if isinstance(one, AfterValidator)
    ]
    scalars = tuple(name for name in names if name not in {*arrays, *nested})
    in_order = tuple(name for name in kind.names if name in names) == names
    return _Form(scalars, arrays, nested, tuple(checks), in_order)


@cache
def _checker_of(kind: type[Message]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return what checks the scalars of a message."""
    others = kind.arrays.keys() | kind.nested.keys()
    hints = get_type_hints(kind, include_extras=True)
    scalars = {name: hints[name] for name in kind.names if name not in others}
    return TypeAdapter(_TypedDict(kind.__name__, scalars, total=False)).validate_python


@cache
def _type_of(kind: type[Message]) -> Any:
    """Return the type by which msgspec decodes a message: that of the model, its arrays as blocks."""
    types = {name: hint for name, hint in get_type_hints(kind, include_extras=True).items() if name in kind.names}
    types |= dict.fromkeys(kind.arrays, Block)
    types |= {name: _type_of(inner) for name, inner in kind.nested.items()}
    if "labels" in types:
        types["labels"] = Annotated[list[str], msgspec.Meta(max_length=256)]
    return _TypedDict(kind.__name__, types, total=False)


# Made on import: of two threads that ask msgspec for a decoder at once, one would use a type that is not complete.
DECODERS: Final[dict[type[Message], Callable[[bytes], dict[str, Any]]]] = {
    kind: msgspec.msgpack.Decoder(_type_of(kind)).decode for kind in (Detections, Points, Tracks, Density)
}
"""Functions that decode the fields of messages with columns by their types alone; they raise what `REFUSED` names."""

_encode: Final = msgspec.msgpack.Encoder().encode


def read(payload: bytes, kind: type[T], limits: Limits) -> T | None:
    """Return the message of a payload in this form, else None."""
    fields_of = DECODERS.get(kind)
    if fields_of is None:
        return None
    try:
        fields = fields_of(payload)
        message = checked(fields, kind, limits)
    except REFUSED:
        return None
    is_small = len(payload) <= MOST_BYTES and _encode(fields) == payload
    if not is_small and not is_encoding(payload, message):
        return None
    if isinstance(message, Detections) and (not is_small or _is_in_order(fields, kind, len(payload))):
        object.__setattr__(message, "encoded", payload)
    return message


def _is_in_order(fields: dict[str, Any], kind: type[Message], size: int) -> bool:
    """Return whether `encode` gives these fields in this order, and the blocks among them without padding."""
    form = _form_of(kind, tuple(fields))
    if not form.in_order or None in [fields[name] for name in form.scalars]:
        return False
    if size >= LARGE and any(len(fields[name].data) >= LARGE for name in form.arrays):
        return False
    return not form.nested or all(tuple(fields[name]) == kind.nested[name].names for name in form.nested)


def checked(fields: dict[str, Any], kind: type[T], limits: Limits) -> T:
    """Return the message of its fields, arrays as blocks and messages as their fields.

    Raises:
        ValueError, TypeError, LookupError: it is not valid, or not in this form.
    """
    form = _form_of(kind, tuple(fields))
    _need(_LITTLE and (limits is DEFAULT or _is_generous(limits)))
    values = kind.optional | _checker_of(kind)({name: fields[name] for name in form.scalars})
    for name in form.nested:
        inner = kind.nested[name]
        part = fields[name]
        values[name] = _part(inner, *_data_of(part, inner)) if inner in _PARTS else checked(part, inner, limits)
    if form.arrays:
        key = tuple([(name, (one := fields[name]).dtype, tuple(one.shape), len(one.data)) for name in form.arrays])
        values |= _plan_of(kind, key, limits)(fields)
    for name, check in form.checks:
        check(values[name])
    message = kind.of_valid(values, set(fields))
    message.check()
    return message


def _data_of(fields: dict[str, Block], kind: type[Message]) -> list[bytes]:
    """Return the bytes of the few arrays of a message inside another. Raises ValueError: they are of another form."""
    _need(len(fields) == len(kind.arrays))
    blocks = [(fields[name], described) for name, described in kind.arrays.items()]
    _need(all(block.dtype == described.dtype and block.shape == [*described.shape] for block, described in blocks))
    return [bytes(block.data) for block, _ in blocks]


@lru_cache(1024)
def _part(kind: type[Message], *data: bytes) -> Message:
    """Return a message of a few arrays of their bytes: most sensors send the same ones over and over."""
    arrays = {}
    for (name, described), numbers in zip(kind.arrays.items(), data, strict=True):
        _need(len(numbers) == 8 * int(described.shape[0]))
        _need(all(described.low <= one <= described.high for one in unpack(f"<{described.shape[0]}d", numbers)))
        arrays[name] = np.frombuffer(numbers)
    for name, check in _form_of(kind, tuple(arrays)).checks:
        check(arrays[name])
    message = kind.trusted(arrays)
    message.check()
    return message


def _is_generous(limits: Limits) -> bool:
    return (
        limits.max_text >= _MOST_TEXT
        and limits.max_values >= _MOST_VALUES
        and limits.max_depth >= _MOST_DEPTH
        and limits.max_labels >= DEFAULT.max_labels
    )


_Key = tuple[tuple[str, str, tuple[int, ...], int], ...]
_Plan = Callable[[dict[str, Block]], dict[str, Any]]


@lru_cache(64)
def _plan_of(kind: type[Message], key: _Key, limits: Limits) -> _Plan:
    """Return what makes arrays of blocks with these names, number types, shapes and bytes.

    Raises:
        ValueError: no message has them.
    """
    lengths: dict[str, int] = {}
    for name, dtype, shape, size in key:
        described = kind.arrays[name]
        _need(dtype == described.dtype and size == DTYPES[dtype] * prod(shape) > 0)
        for want, length in zip(described.shape, shape, strict=True):
            _need(length == (want if isinstance(want, int) else lengths.setdefault(want, length)))
    _need(all(0 < length <= limits.rows(letter) for letter, length in lengths.items()))
    shapes = {name: shape for name, _, shape, _ in key}
    if sum(map(prod, shapes.values())) > MOST_NUMBERS:
        return lambda blocks: {
            name: _column(blocks[name].data, kind.arrays[name], shape) for name, shape in shapes.items()
        }
    by_type: dict[str, dict[str, tuple[int, ...]]] = {}
    for name, shape in shapes.items():
        by_type.setdefault(kind.arrays[name].dtype, {})[name] = shape
    groups = [_Group.of(kind, dtype, members) for dtype, members in by_type.items()]

    def arrays_of(blocks: dict[str, Block]) -> dict[str, Any]:
        arrays: dict[str, Any] = {}
        for group in groups:
            group.read(blocks, arrays)
        return arrays

    return arrays_of


def _column(data: memoryview, described: Array, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return a column, a view of the bytes where they are aligned. Raises ValueError: a number is out of its range."""
    array = numeric.canonical(np.frombuffer(data, described.dtype).reshape(shape), described)
    _need(numeric.first_outside(array, described) is None)
    return array


@dataclass(frozen=True, slots=True)
class _Group:
    """Columns of one number type, one behind the other, those with unknown rows last.

    Attributes:
        dtype: their number type.
        columns: name, place and shape of each, None for one dimension, and whether rows of it may be unknown.
        known: how many numbers must be within their bounds.
        low, high: bounds of each number.
    """

    dtype: str
    columns: tuple[tuple[str, slice, tuple[int, ...] | None, bool], ...]
    known: int
    low: NDArray[Any]
    high: NDArray[Any]

    @classmethod
    def of(cls, kind: type[Message], dtype: str, shapes: dict[str, tuple[int, ...]]) -> "_Group":
        columns, end, known = [], 0, 0
        low, high = [], []
        for name in sorted(shapes, key=lambda name: kind.arrays[name].unknown):
            described, begin, size = kind.arrays[name], end, prod(shapes[name])
            end += size
            known = known if described.unknown else end
            shape = shapes[name] if len(shapes[name]) > 1 else None
            columns.append((name, slice(begin, end), shape, described.unknown))
            least = np.asarray(described.low, dtype)
            low.append(np.full(size, np.nextafter(least, np.inf, dtype=dtype) if described.above else least))
            high.append(np.full(size, described.high, dtype))
        return cls(dtype, tuple(columns), known, np.concatenate(low), np.concatenate(high))

    def read(self, blocks: dict[str, Block], arrays: dict[str, Any]) -> None:
        """Add the columns to the arrays. Raises ValueError: a number is out of its range."""
        numbers = np.frombuffer(b"".join([blocks[name].data for name, *_ in self.columns]), self.dtype)
        good = (numbers >= self.low) & (numbers <= self.high)
        for name, place, shape, _ in self.columns:
            arrays[name] = numbers[place] if shape is None else numbers[place].reshape(shape)
        if not good[good.argmin()]:
            _need(bool(good[: self.known].all()))
            for name, place, _, unknown in self.columns:
                if unknown:
                    unknown_rows = np.isnan(array := arrays[name]).all(axis=-1, keepdims=True)
                    _need(bool((good[place].reshape(array.shape) | unknown_rows).all()))


def _need(fact: bool) -> None:  # noqa: FBT001 - one condition, as after assert
    if not fact:
        raise ValueError
