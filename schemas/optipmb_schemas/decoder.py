"""Decode messages with columns by msgspec, by structs that come from the pydantic models.

Nothing is refused here. A payload that is not plainly a valid message gives None; `codec` then reads it by the models
or names the error. So there is one set of rules and one set of errors. Tests hold the messages of both ways equal.

Memory is bounded: msgspec builds what the types allow, tuples of a few elements and views of the payload. Of a map with
a field twice it takes the last one, and it skips unknown fields. So the fields are encoded again. That gives as many
bytes only if every field is there once, whatever their order: no other form of these types is shorter, but of floats.
Where it would copy a large payload, `is_encoding` compares the payload without them.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from math import prod
from operator import attrgetter
from struct import unpack
from typing import Annotated, Any, Final, Literal, TypeVar, get_type_hints

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
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

_MOST_LABELS: Final = 256
_MOST_TEXT: Final = 2000
_MOST_VALUES: Final = 1000
_MOST_DEPTH: Final = 4
"""Bytes of a text, values and levels of lists and maps that no valid message in this form exceeds."""

_TypedDict: Any = TypedDict  # made of types that are not known before
_PARTS: Final[frozenset[type[Message]]] = frozenset({Pose, FieldOfView})
"""Messages inside others that have required float64 arrays of fixed lengths and closed ranges alone."""
_LITTLE: Final = sys.byteorder == "little"
_SMALL_MAP: Final = 15
_BOUNDS: Final = ("ge", "gt", "le", "lt")
REFUSED: Final = (msgspec.MsgspecError, ValueError, TypeError, LookupError, RecursionError)
"""Errors of a payload that is not valid, or not in this form."""


@cache
def _block_of(dtype: str, dimensions: int) -> Any:
    """Return the type of array blocks of a number type."""
    shape: Any = tuple[(int,) * dimensions]  # type: ignore[misc]
    fields = [("dtype", Literal[dtype]), ("shape", shape), ("data", memoryview)]
    return msgspec.defstruct("Block", fields, frozen=True, gc=False)


_ABSENT: Final = _block_of("f8", 1)("f8", None, b"")
"""In the place of an array that is absent."""


@cache
def _struct_of(kind: type[Message]) -> Any:
    """Return the struct by which msgspec decodes a message: the fields of the model, its arrays as blocks."""
    hints = get_type_hints(kind, include_extras=True)
    hints |= {name: _number_of(kind, name) for name in _numbers_of(kind)}
    hints |= {name: _block_of(array.dtype, len(array.shape)) for name, array in kind.arrays.items()}
    hints |= {name: _struct_of(inner) for name, inner in kind.nested.items()}
    if "labels" in hints:
        hints["labels"] = Annotated[tuple[str, ...], msgspec.Meta(max_length=_MOST_LABELS)]
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
    """Return what checks the scalars of a message as its model does."""
    hints = get_type_hints(kind, include_extras=True)
    scalars = {name: hints[name] for name in _scalars_of(kind)}
    return TypeAdapter(_TypedDict(kind.__name__, scalars, total=False)).validate_python


# Streams send the same names over and over.


@lru_cache(512)
def _checked_scalars(kind: type[Message], *values: Any) -> tuple[dict[str, Any], frozenset[str]]:
    """Return the scalars with the defaults of all fields, and the names of those that are there."""
    given = {name: value for name, value in zip(_scalars_of(kind), values, strict=True) if value is not UNSET}
    _need(None not in given.values())
    return kind.optional | _checker_of(kind)(given), frozenset((*given, *_numbers_of(kind)))


@lru_cache(1024)
def _part(kind: type[Message], *data: bytes) -> Message:
    """Return a message of a few arrays of their bytes."""
    arrays = {}
    for (name, described), numbers in zip(kind.arrays.items(), data, strict=True):
        _need(len(numbers) == 8 * int(described.shape[0]))
        _need(all(described.low <= one <= described.high for one in unpack(f"<{described.shape[0]}d", numbers)))
        arrays[name] = np.frombuffer(numbers)
    for name, check in _checks_of(kind):
        check(arrays[name])
    message = kind.trusted(arrays)
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
            return _part(kind, *map(bytes, self._data_in(fields)))
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
            _need(plan.is_usual if limits is DEFAULT else plan.is_within(limits))
            for column in plan.columns:
                column.read(data, values)
            given |= plan.names
        for name, check in self._checks:
            if values[name] is not None:
                check(values[name])
        message = kind.of_valid(values, given)
        message.check()
        return message


@dataclass(frozen=True, slots=True)
class _Columns:
    """Columns of one number type, one behind the other, those with unknown rows last.

    Attributes:
        dtype: their number type.
        order: which of the arrays they are.
        places: name, place and shape of each, None for one dimension, and whether rows of it may be unknown.
        known: how many numbers must be within their bounds.
        low, high: bounds of each number.
    """

    dtype: str
    order: tuple[int, ...]
    places: tuple[tuple[str, slice, tuple[int, ...] | None, bool], ...]
    known: int
    low: NDArray[Any]
    high: NDArray[Any]

    @classmethod
    def of(cls, dtype: str, arrays: list[tuple[int, str, Array, tuple[int, ...]]]) -> "_Columns":
        arrays = sorted(arrays, key=lambda one: one[2].unknown)
        places, end, known = [], 0, 0
        low, high = [], []
        for _, name, described, shape in arrays:
            begin, size = end, prod(shape)
            end += size
            known = known if described.unknown else end
            places.append((name, slice(begin, end), shape if len(shape) > 1 else None, described.unknown))
            low.append(np.full(size, _least(described), dtype))
            high.append(np.full(size, described.high, dtype))
        order = tuple(at for at, *_ in arrays)
        return cls(dtype, order, tuple(places), known, np.concatenate(low), np.concatenate(high))

    def read(self, data: tuple[memoryview, ...], values: dict[str, Any]) -> None:
        """Add the columns to the values. Raises ValueError: a number is out of its range."""
        numbers = np.frombuffer(b"".join([data[at] for at in self.order]), self.dtype)
        good = (numbers >= self.low) & (numbers <= self.high)
        for name, place, shape, _ in self.places:
            values[name] = numbers[place] if shape is None else numbers[place].reshape(shape)
        if not good[good.argmin()]:
            _need(bool(good[: self.known].all()))
            for name, place, _, unknown in self.places:
                if unknown:
                    unknown_rows = np.isnan(array := values[name]).all(axis=-1, keepdims=True)
                    _need(bool((good[place].reshape(array.shape) | unknown_rows).all()))


@dataclass(frozen=True, slots=True)
class _Column:
    """A single column."""

    at: int
    name: str
    described: Array
    shape: tuple[int, ...]
    low: Any

    def read(self, data: tuple[memoryview, ...], values: dict[str, Any]) -> None:
        """Add the column to the values, a view of the payload where that is large and aligned."""
        block, described = data[self.at], self.described
        numbers = np.frombuffer(block if len(block) >= LARGE else bytes(block), described.dtype)
        if not numbers.flags.aligned:
            numbers = np.frombuffer(bytes(block), described.dtype)
        values[self.name] = array = numbers.reshape(self.shape)
        # Both are NaN where there is one, and comparisons with NaN are false.
        if not (numbers[numbers.argmin()] >= self.low and numbers[numbers.argmax()] <= described.high):
            _need(described.unknown and numeric.first_outside(array, described) is None)


@dataclass(slots=True)
class _Plan:
    """How arrays of some shapes are read.

    Attributes:
        names: those that are there.
        sizes: bytes of all.
        lengths: symbolic dimensions.
        columns: those of each number type, or every one for itself.
        is_usual: whether they are within the default limits.
    """

    names: frozenset[str]
    sizes: list[int]
    lengths: tuple[tuple[str, int], ...]
    columns: tuple[_Columns | _Column, ...]
    is_usual: bool = field(init=False)

    def __post_init__(self) -> None:
        self.is_usual = self.is_within(DEFAULT)

    def is_within(self, limits: Limits) -> bool:
        """Return whether no dimension is above a limit."""
        return all(length <= limits.rows(letter) for letter, length in self.lengths)


@lru_cache(64)
def _plan_of(kind: type[Message], shapes: tuple[tuple[int, ...] | None, ...]) -> _Plan:
    """Return how arrays of these shapes are read, None where one is absent. Raises ValueError: no message has them."""
    lengths: dict[str, int] = {}
    arrays = []
    for at, ((name, described), shape) in enumerate(zip(kind.arrays.items(), shapes, strict=True)):
        if shape is None:
            continue
        for want, length in zip(described.shape, shape, strict=True):
            _need(0 < length == (want if isinstance(want, int) else lengths.setdefault(want, length)))
        arrays.append((at, name, described, shape))
    sizes = [0] * len(shapes)
    for at, _, described, shape in arrays:
        sizes[at] = DTYPES[described.dtype] * prod(shape)
    columns: list[_Columns | _Column] = []
    many = sum(prod(shape) for *_, shape in arrays) > MOST_NUMBERS
    for dtype in dict.fromkeys(described.dtype for _, _, described, _ in arrays):
        alike = [one for one in arrays if one[2].dtype == dtype]
        if many or len(alike) == 1:
            columns += [_Column(*one, _least(one[2])) for one in alike]
        else:
            columns.append(_Columns.of(dtype, alike))
    return _Plan(frozenset(name for _, name, *_ in arrays), sizes, tuple(lengths.items()), tuple(columns))


def _least(described: Array) -> Any:
    """Return the least number of a column."""
    low: Any = np.asarray(described.low, described.dtype)
    return (np.nextafter(low, np.inf, dtype=low.dtype) if described.above else low).item()


def _values_of(names: Sequence[str]) -> Callable[[Any], tuple[Any, ...]]:
    """Return what returns the values of some attributes."""
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

_encoder: Final = msgspec.msgpack.Encoder()


def _encode(fields: Any) -> bytes:
    """Return a struct as msgpack, whose head msgspec makes of three bytes where the type has 16 fields."""
    again = _encoder.encode(fields)
    return again if again[:2] != b"\xde\0" or again[2] > _SMALL_MAP else bytes([0x80 | again[2]]) + again[3:]


def read(payload: bytes, kind: type[T], limits: Limits) -> T | None:
    """Return the message of a payload in this form, else None."""
    builder: Any = _BUILDERS.get(kind)
    if builder is None or not (_LITTLE and (limits is DEFAULT or _is_generous(limits))):
        return None
    try:
        fields = DECODERS[kind](payload)
        message: T = builder.message(fields, limits)
    except REFUSED:
        return None
    has_large = len(payload) >= LARGE and any(value.nbytes >= LARGE for value in _arrays_of(message))
    is_encoded = is_encoding(payload, message) if has_large else _encode(fields) == payload
    # A float of `Tracks` may be written in fewer bytes, which a field that is there twice could make up for.
    if not is_encoded and (len(payload) > MOST_BYTES or kind is Tracks or len(_encode(fields)) != len(payload)):
        return None
    if is_encoded and isinstance(message, Detections):
        object.__setattr__(message, "encoded", payload)
    return message


def _arrays_of(message: Message) -> list[NDArray[Any]]:
    values = message.__dict__
    return [value for name in message.arrays if (value := values[name]) is not None]


def _is_generous(limits: Limits) -> bool:
    return (
        limits.max_text >= _MOST_TEXT
        and limits.max_values >= _MOST_VALUES
        and limits.max_depth >= _MOST_DEPTH
        and limits.max_labels >= DEFAULT.max_labels
    )
