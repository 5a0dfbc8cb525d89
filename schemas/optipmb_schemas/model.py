"""The rules of all messages: kinds of scalar fields, and the models that are made of them and of arrays.

No field converts: a text is no number, `true` is no integer, 1.0 is no integer either. Integers fit 64 bits with sign;
numbers are finite. Models are frozen, their errors name the field, and their arrays agree in their rows.
"""

import math
import re
from functools import lru_cache
from types import UnionType
from typing import Annotated, Any, ClassVar, Final, Self, Union, get_args, get_origin

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    WithJsonSchema,
    model_validator,
)

from optipmb_schemas.arrays import Array, Reals, first_descent
from optipmb_schemas.errors import MessageError, cut, invalid, path_of, shape_text, show

CHUNK: Final = r"[A-Za-z0-9_.-]+"
"""One part of a stream name or key."""
MAX_NAME: Final = 200
"""Most characters of a stream name, an instance name or a profile name."""
MAX_TEXT: Final = 500
"""Most characters of a text for people."""
RESERVED: Final = frozenset({"owner", "service"})
"""First parts that no stream may have, because keys of the service start with them."""

_INT64: Final = 2**63 - 1
_DEPTH: Final = 10  # within the nesting that decoding allows
_EPOCH: Final = 16
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
_STREAM: Final = re.compile(rf"{CHUNK}/{CHUNK}/{CHUNK}")
_CHUNK: Final = re.compile(CHUNK)


def check_chunk(text: str) -> str:
    """Return `text` when it is one part of a key: letters, digits, `_`, `.` and `-`, not `.` or `..`."""
    if len(text) > MAX_NAME or not _CHUNK.fullmatch(text) or text in {".", ".."}:
        raise invalid("", "a name of letters, digits and _ . -, without /", text)
    return text


@lru_cache(4096)
def check_stream(text: str) -> str:
    """Return `text` when it is the name of a stream: `site/node/sensor`."""
    if len(text) > MAX_NAME or not _STREAM.fullmatch(text):
        raise invalid("", "a stream as site/node/sensor, each of letters, digits and _ . -", text)
    parts = text.split("/")
    if parts[0] in RESERVED or not {".", ".."}.isdisjoint(parts):
        raise invalid("", "a stream whose site is not owner or service and whose parts are not . or ..", text)
    return text


def _epoch(value: Any) -> Any:
    if isinstance(value, str) and re.fullmatch(r"[0-9a-fA-F]{32}", value):
        return bytes.fromhex(value)
    if not isinstance(value, bytes) or len(value) != _EPOCH:
        raise invalid("", "16 bytes (JSON: 32 hexadecimal digits)", value)
    return value


def _plain(value: Any, path: str = "", depth: int = 0) -> Any:
    """Return a value that is made of what JSON can say: 64-bit integers, finite numbers, texts, lists, maps."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int) and -_INT64 - 1 <= value <= _INT64:
        return value
    if isinstance(value, float) and math.isfinite(value):
        return value
    if isinstance(value, str) and not _SURROGATE.search(value):
        return value
    if depth < _DEPTH and isinstance(value, list | tuple):
        return [_plain(item, f"{path}[{i}]", depth + 1) for i, item in enumerate(value)]
    if depth < _DEPTH and isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {_plain(key, path): _plain(item, _inside(path, key), depth + 1) for key, item in value.items()}
    raise invalid(path, "a plain value: null, boolean, 64-bit integer, finite number, text, list or map", value)


def _inside(path: str, key: str) -> str:
    return cut(f"{path}.{ascii(key)[1:-1]}".removeprefix("."))


@lru_cache(64)
def check_labels(labels: tuple[str, ...]) -> tuple[str, ...]:
    """Return `labels` when all are printable and differ from each other."""
    for i, label in enumerate(labels):
        if not label.isprintable():
            raise invalid(f"[{i}]", "a label of printable characters", label)
        if label in labels[:i]:
            raise invalid(f"[{i}]", "labels that differ from each other", label)
    return labels


def check_horizons(horizons: Reals) -> Reals:
    """Return `horizons` when they ascend."""
    if at := first_descent(horizons):
        raise invalid(f"[{at}]", f"a number above {horizons[at - 1]:g}, in ascending order", horizons[at])
    return horizons


Flag = Annotated[bool, Field(strict=True)]
Count = Annotated[int, Field(strict=True, ge=0, le=_INT64)]
Stamp = Annotated[int, Field(strict=True, ge=0, le=_INT64)]
NonNegative = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0)]
Text = Annotated[str, Field(strict=True, max_length=MAX_TEXT)]
Word = Annotated[str, Field(strict=True, min_length=1, max_length=MAX_NAME)]
Stream = Annotated[
    str,
    Field(strict=True, max_length=MAX_NAME),
    AfterValidator(check_stream),
    WithJsonSchema({"type": "string", "maxLength": MAX_NAME, "pattern": f"^{CHUNK}/{CHUNK}/{CHUNK}$"}),
]
Name = Annotated[
    str,
    Field(strict=True, max_length=MAX_NAME),
    AfterValidator(check_chunk),
    WithJsonSchema({"type": "string", "maxLength": MAX_NAME, "pattern": f"^{CHUNK}$"}),
]
SessionId = Annotated[str, Field(strict=True, pattern="^[0-9a-f]{32}$")]
Epoch = Annotated[
    bytes,
    BeforeValidator(_epoch),
    PlainSerializer(bytes.hex, return_type=str, when_used="json"),
    WithJsonSchema({"type": "string", "pattern": "^[0-9a-fA-F]{32}$"}),
]
Plain = Annotated[dict[str, Any], AfterValidator(_plain)]
Horizons = Annotated[Reals, Array("f8", ("H",), 0, 30, above=True), AfterValidator(check_horizons)]
Labels = Annotated[
    tuple[Annotated[str, Field(strict=True, min_length=1, max_length=64)], ...],
    Field(max_length=256, fail_fast=True),
    AfterValidator(check_labels),
]


class Message(BaseModel):
    """Base of every message and of what messages hold.

    Fields that are not known are ignored: a newer minor version may have added them. Arrays are views of what the
    constructor was given if possible, so its arrays must not be changed afterwards.

    Raises:
        MessageError: when a field is missing or not valid.
    """

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)

    names: ClassVar[tuple[str, ...]] = ()
    """Names of the fields, in the order of their description."""
    names_required: ClassVar[frozenset[str]] = frozenset()
    """Names of those without a default."""
    arrays: ClassVar[dict[str, Array]] = {}
    """Descriptions of the array fields, by name."""
    columns: ClassVar[tuple[tuple[str, int, str], ...]] = ()
    """Name, dimension and letter of all symbolic dimensions of array fields."""
    optional: ClassVar[dict[str, Any]] = {}
    """Values of the fields that need not be given, by name."""
    nested: ClassVar[dict[str, type["Message"]]] = {}
    """Message types of the fields that hold one message, by name."""

    def __init__(self, /, **fields: Any) -> None:
        try:
            super().__init__(**fields)
        except ValidationError as error:
            raise first_error(error) from None

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Collect the array fields once per class."""
        super().__pydantic_init_subclass__(**kwargs)
        cls.arrays, cls.nested = {}, {}
        for name in cls.model_fields:
            for part in cls.metadata_of(name):
                if isinstance(part, Array):
                    cls.arrays[name] = part
                elif isinstance(part, type) and issubclass(part, Message):
                    cls.nested[name] = part
        cls.optional = {name: one.default for name, one in cls.model_fields.items() if not one.is_required()}
        cls.names = tuple(cls.model_fields)
        cls.names_required = frozenset(cls.names) - cls.optional.keys()
        cls.columns = tuple((name, axis, letter) for name, one in cls.arrays.items() for axis, letter in one.letters)

    @classmethod
    def metadata_of(cls, name: str) -> list[Any]:
        """Return the alternatives of the type of a field, and what its description adds to each."""
        info = cls.model_fields[name]
        return [*info.metadata, *_parts(info.annotation)]

    @classmethod
    def trusted(cls, fields: dict[str, Any]) -> Self:
        """Return the message of values that are known to be valid, without checking them again.

        For what a program has made itself out of values that were checked. Every value has the type that the field
        holds, arrays their dtype, C order, and are read-only; all fields are given that have no default.
        """
        return cls.of_valid(cls.optional | fields, set(fields))

    @classmethod
    def of_valid(cls, values: dict[str, Any], given: set[str]) -> Self:
        """Return the message of the values of all fields, read-only arrays among them, of which `given` were given.

        It does what pydantic's `model_construct` does, without looking at every field of the description.
        """
        message = object.__new__(cls)
        set_attribute = object.__setattr__
        set_attribute(message, "__dict__", values)
        set_attribute(message, "__pydantic_fields_set__", given)
        set_attribute(message, "__pydantic_extra__", None)
        set_attribute(message, "__pydantic_private__", None)
        return message

    @model_validator(mode="after")
    def _check(self) -> Self:
        rows: dict[str, tuple[str, int]] = {}
        values = self.__dict__
        for name, axis, letter in self.columns:
            array = values[name]
            if array is None:
                continue
            length = array.shape[axis]
            first, number = rows.setdefault(letter, (name, length))
            if length != number and axis and not len(array):  # lists cannot say how long the rows of no rows are
                values[name] = array.reshape((*array.shape[:axis], number, *array.shape[axis + 1 :]))
            elif length != number:
                what = "of dimension " + letter if axis else "rows"
                expected = f"{number} {what} as in {first}, for shape {self.arrays[name].shape_described}"
                raise MessageError("invalid_value", name, expected, f"shape {shape_text(array.shape)}")
        self.check()
        return self

    def check(self) -> None:
        """Check what concerns several fields. Raises MessageError."""

    def present(self) -> list[tuple[str, Any]]:
        """Return the names and values of the fields that are not None, in the order of their description."""
        values = self.__dict__
        return [(name, value) for name in self.names if (value := values[name]) is not None]

    def __eq__(self, other: object) -> bool:
        """Equal messages have equal bytes on the wire; NaN equals NaN here, and 0.0 differs from -0.0 in arrays."""
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, name), getattr(other, name)) for name in self.names)

    __hash__ = BaseModel.__hash__  # pydantic's, of all fields: messages with arrays are not hashable

    def __repr_args__(self) -> list[tuple[str | None, Any]]:
        """Show arrays by type and shape."""
        return [(n, show(v) if isinstance(v, np.ndarray) else v) for n, v in self.present()]


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return isinstance(other, np.ndarray) and one.shape == other.shape and one.tobytes() == other.tobytes()
    return bool(one == other)


def _parts(annotation: Any) -> list[Any]:
    """Return what an annotation is made of: the alternatives of a union and the metadata of each."""
    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        return [*_parts(inner), *metadata]
    if get_origin(annotation) in {Union, UnionType}:
        return [part for alternative in get_args(annotation) for part in _parts(alternative)]
    return [annotation]


def first_error(error: ValidationError) -> MessageError:
    """Return the first of pydantic's errors as ours."""
    first = error.errors(include_url=False)[0]
    path = path_of(first["loc"])
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, MessageError):
        return cause.under(path) if path else cause
    if first["type"] == "missing":
        return MessageError("missing_field", path, "a value", "nothing")
    return invalid(path, _expected(first["msg"]), first["input"])


_PHRASES: Final = (
    ("be a valid tuple", "a list"),
    ("be a valid dictionary", "a map"),
    ("be greater", "a number greater"),
    ("be less", "a number less"),
    ("have ", "a value of "),
    ("match pattern", "a text that matches"),
    ("be ", ""),
)


def _expected(sentence: str) -> str:
    """Return what pydantic's sentence asks for: `Input should be a valid string` asks for `a valid string`."""
    _, _, rest = sentence.partition(" should ")
    for start, ours in _PHRASES:
        if rest.startswith(start):
            return ours + rest.removeprefix(start)
    return sentence
