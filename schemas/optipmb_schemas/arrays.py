"""Columnar arrays as pydantic fields: one value per column, checked with whole-array operations.

`Annotated[Reals, Array("f8", ("M", 3), low, high)]` is an array of M rows of 3 numbers. A field may be
given an array of another number type, a buffer, or nested lists. It always holds a numpy array of the number type of
the description, row by row and read-only (`numeric`). An array or buffer that is all this already is held as a view.

A letter is a symbolic dimension: equal letters are equal numbers within one message (`Message` compares them).
"""

import sys
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from math import hypot, nan
from operator import le
from typing import TYPE_CHECKING, Any, Final, Literal

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from optipmb_schemas import numeric
from optipmb_schemas.errors import MessageError, cut, invalid, shape_text

if sys.byteorder != "little":
    raise ImportError("the messages need a little-endian machine")

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    Reals = NDArray[np.float64]
    Singles = NDArray[np.float32]
    Integers = NDArray[np.int64]
    Numeric = NDArray[Any]
else:  # pydantic looks at the `Array` in their metadata alone
    ArrayLike = Reals = Singles = Integers = Numeric = Any

__all__ = [
    "MAX_COLUMNS",
    "Array",
    "ArrayLike",
    "Integers",
    "Numeric",
    "Reals",
    "Singles",
    "first_descent",
    "numeric",
    "unit_quaternion",
]

MAX_COLUMNS: Final = 64
"""Most columns of an array whose further columns are dropped."""


@dataclass(frozen=True)
class Array:
    """Description of one array field.

    Attributes:
        dtype: `f4`, `f8` or `i8`: what the field holds.
        shape: numbers, or letters for symbolic dimensions, the first of which is a number of rows.
        low, high: range of every value, both ends included. NaN and infinity are in no range.
        above: the values must be greater than `low`, not equal.
        unknown: what may be NaN (null in JSON), not known for this object: a whole `row`, any `number`, or the `last`
            one of a row; empty: nothing.
        wider: the last dimension may be larger than described; further columns are dropped.
        hint: added to the range in errors.
    """

    dtype: str
    shape: tuple[str | int, ...]
    low: float
    high: float
    above: bool = False
    unknown: Literal["", "row", "number", "last"] = ""
    wider: bool = False
    hint: str = ""

    @cached_property
    def rows(self) -> str | None:
        """The letter of the symbolic number of rows."""
        return self.shape[0] if isinstance(self.shape[0], str) else None

    @cached_property
    def letters(self) -> tuple[tuple[int, str], ...]:
        """The symbolic dimensions: which one it is, and its letter."""
        return tuple((axis, want) for axis, want in enumerate(self.shape) if isinstance(want, str))

    @property
    def shape_described(self) -> str:
        """The shape for people, as `(M, 3)`."""
        return shape_text((*self.shape[:-1], f"{self.shape[-1]} or more") if self.wider else self.shape)

    @property
    def range_described(self) -> str:
        """The range of the values for people, as `a number in (0, 1]`."""
        if self.dtype == "i8":
            return f"an integer from {self.low} to {self.high}"
        return f"a number in {'(' if self.above else '['}{self.low:g}, {self.high:g}]".replace("e+0", "e").replace(
            "e+", "e"
        )

    def check_shape(self, shape: tuple[int, ...]) -> None:
        """Refuse a shape that the description does not allow. A symbolic dimension may be anything here."""
        columns = self.shape[-1]
        if self.wider and isinstance(columns, int) and len(shape) > 1 and columns < shape[-1] <= MAX_COLUMNS:
            shape = (*shape[:-1], columns)
        if shape[1:] == self.shape[1:] and len(shape) == len(self.shape) and (self.rows or shape == self.shape):
            return
        if len(self.letters) > 1 and len(shape) == len(self.shape):
            wanted = zip(self.shape, shape, strict=True)
            if all(want == length or isinstance(want, str) for want, length in wanted):
                return
        raise MessageError("invalid_value", "", f"shape {self.shape_described}", f"shape {cut(shape_text(shape))}")

    def of_another_kind(self, dtype: object) -> MessageError:
        """Return the error of an array whose elements are not of the kind that is described."""
        kind = "integers" if self.dtype == "i8" else "numbers"
        return MessageError("invalid_value", "", f"an array of {kind}", cut(f"an array of {dtype}"))

    def refused(self, at: int, array: Any) -> MessageError:
        """Return the error of an array whose number `at`, counted row by row, is out of the range."""
        return invalid(_element(at, array.shape), f"{self.range_described}{self.hint}", array.flat[at])

    def validate(self, value: object) -> Numeric:
        """Return `value` as the array that the description asks for.

        Raises:
            MessageError: with a path relative to the field, as `[7][1]`, when a shape, type or value is not allowed.
        """
        array = numeric.given(value)
        if array is None:
            array = self.from_lists(value)
        self.check_shape(array.shape)
        array = numeric.canonical(array, self)
        if array.size and (at := numeric.first_outside(array, self)) is not None:
            raise self.refused(at, array)
        return array

    def from_lists(self, value: object) -> Numeric:
        """Return nested lists of numbers (None for an unknown number where that is allowed) as an array."""
        leaves, shape = self._flatten(value)
        kinds = set(map(type, leaves))
        if self.unknown and type(None) in kinds:
            leaves = [nan if leaf is None else leaf for leaf in leaves]
            kinds.discard(type(None))
        whole = self.dtype == "i8"
        wanted = numeric.WHOLE if whole else numeric.REAL
        bad = {kind for kind in kinds if kind is bool or not issubclass(kind, wanted)}
        if bad:
            at = next(i for i, leaf in enumerate(leaves) if type(leaf) in bad)
            raise invalid(_element(at, shape), "an integer" if whole else "a number", leaves[at])
        try:
            return numeric.of_leaves(leaves, "i8" if whole else "f8", shape)
        except OverflowError:  # an integer beyond what the array can hold: say which
            at = next(i for i, leaf in enumerate(leaves) if not self.low <= leaf <= self.high)
            raise invalid(_element(at, shape), f"{self.range_described}{self.hint}", leaves[at]) from None

    def _flatten(self, value: object) -> tuple[list[Any], tuple[int, ...]]:
        """Return the numbers and the shape of nested lists. Every level is checked before the next is opened."""
        level: list[Any] = [value]
        shape: tuple[int, ...] = ()
        for depth, want in enumerate(self.shape):
            if not level:  # no rows: their lengths are the described ones, and a symbolic one is not known
                return [], (*shape, *(n if isinstance(n, int) else 0 for n in self.shape[depth:]))
            if not set(map(type, level)) <= {list, tuple}:
                at = next(i for i, item in enumerate(level) if type(item) not in {list, tuple})
                expected = "a list" if depth else f"an array of shape {self.shape_described}"
                raise invalid(_element(at, shape), expected, level[at])
            length = len(level[0])
            if set(map(len, level)) != {length}:
                at = next(i for i, item in enumerate(level) if len(item) != length)
                raise invalid(_element(at, shape), f"a list of {length}, as before it", level[at])
            wider = self.wider and depth == len(self.shape) - 1
            if isinstance(want, int) and length != want and not (wider and want < length <= MAX_COLUMNS):
                raise invalid(_element(0, shape), f"a list of {want}, for shape {self.shape_described}", level[0])
            shape = (*shape, length)
            level = list(chain.from_iterable(level))
        return level, shape

    def to_lists(self, array: Numeric) -> list[Any]:
        """Return the array as nested lists for JSON, an unknown number as None."""
        lists: list[Any] = array.tolist()
        return _with_nulls(lists) if self.unknown else lists

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Tell pydantic to hand the value to `validate`."""
        return core_schema.no_info_plain_validator_function(
            self.validate,
            serialization=core_schema.plain_serializer_function_ser_schema(self.to_lists, when_used="json"),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Describe the nested lists; `x-dtype` and `x-shape` describe the array block of msgpack."""
        item: JsonSchemaValue = {"type": ["number", "null"] if self.unknown else "number"}
        if self.dtype == "i8":
            item = {"type": "integer"}
        item |= {"exclusiveMinimum" if self.above else "minimum": self.low, "maximum": self.high}
        for want in reversed(self.shape):
            item = {"type": "array", "items": item}
            if isinstance(want, int):
                item |= {"minItems": want, "maxItems": want}
        if self.wider:
            item["items"]["maxItems"] = MAX_COLUMNS
        return {**item, "x-dtype": self.dtype, "x-shape": list(self.shape)}


def _with_nulls(value: Any) -> Any:
    """Return nested lists with None in place of NaN."""
    if isinstance(value, list):
        return [_with_nulls(item) for item in value]
    return None if value != value else value  # noqa: PLR0124 - NaN differs from itself


def unit_quaternion(array: Reals) -> Reals:
    """Return `array` (4,), w x y z, when its norm is within 0.001 of one, so that float32 sources pass."""
    norm = hypot(*array.tolist())
    if abs(norm - 1.0) > 1e-3:  # noqa: PLR2004 - the tolerance of the description
        raise MessageError("invalid_value", "", "a unit quaternion w, x, y, z", f"one of norm {norm:.6g}")
    return array


def first_descent(array: Numeric) -> int:
    """Return which number of an array (N,) is the first that is not above the one before it; 0: none is."""
    values = array.tolist()
    return next((at for at, fails in enumerate(map(le, values[1:], values), 1) if fails), 0)


def _element(at: int, shape: tuple[int, ...]) -> str:
    """Return the path of the element number `at` of an array: `[7][1]`; empty for an array without dimensions."""
    path = ""
    for length in reversed(shape):
        at, index = divmod(at, length)
        path = f"[{index}]{path}"
    return path
