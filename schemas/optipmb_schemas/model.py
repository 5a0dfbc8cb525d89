"""What all messages share: frozen pydantic models whose errors name the field, and whose arrays agree in their rows."""

from types import UnionType
from typing import Annotated, Any, ClassVar, Final, Self, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from optipmb_schemas.arrays import ARRAY, Array
from optipmb_schemas.errors import MessageError, invalid, path_of, shape_text, show


class Message(BaseModel):
    """Base of every message and of what messages hold.

    Fields that are not known are ignored: a newer minor version may have added them. Arrays are views of what the
    constructor was given wherever that is possible, so its arrays must not be changed afterwards.

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
        return [(n, show(v) if isinstance(v, ARRAY) else v) for n, v in self.present()]


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, ARRAY):
        return isinstance(other, ARRAY) and one.shape == other.shape and one.tobytes() == other.tobytes()
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
