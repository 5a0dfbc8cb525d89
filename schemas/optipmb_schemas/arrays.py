"""Columnar arrays as pydantic fields: one value per column, checked with whole-array operations.

`Annotated[NDArray[np.float64], Array("f8", ("M", 3), low, high)]` is an array of M rows of 3 numbers. Whatever a field
is given (an array of another number type, nested lists), what it holds afterwards is always the same kind of array: the
dtype of the description, native byte order, C-contiguous, aligned and read-only. Compiled code that is specialised on
array types therefore sees one type. An array that is all this already is held as a view, without a copy.

A letter is a symbolic dimension: equal letters are equal numbers within one message (`Message` compares them).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from optipmb_schemas.errors import MessageError, cut, invalid, shape_text

MAX_COLUMNS: Final = 64
"""Most columns of an array whose further columns are dropped."""

_DTYPES: Final = {name: np.dtype(name) for name in ("f4", "f8", "i8")}


@dataclass(frozen=True)
class Array:
    """Description of one array field.

    Attributes:
        dtype: `f4`, `f8` or `i8`: what the field holds.
        shape: numbers, or letters for symbolic dimensions, the first of which is a number of rows.
        low, high: range of every value, both ends included. NaN and infinity are in no range.
        above: the values must be greater than `low`, not equal.
        unknown: a row may be all NaN (null in JSON), which means that it is not known for this object.
        wider: the last dimension may be larger than described; further columns are dropped.
    """

    dtype: str
    shape: tuple[str | int, ...]
    low: float
    high: float
    above: bool = False
    unknown: bool = False
    wider: bool = False

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

    def validate(self, value: object) -> NDArray[Any]:
        """Return `value` as the array that the description asks for.

        Raises:
            MessageError: with a path relative to the field, as `[7][1]`, when a shape, type or value is not allowed.
        """
        array = self._canonical(value if isinstance(value, np.ndarray) else self.from_lists(value))
        if array.size:
            self._check_values(array)
        return array

    def from_lists(self, value: object) -> NDArray[Any]:
        """Return nested lists of numbers (None for an unknown number where that is allowed) as an array."""
        leaves, shape = self._flatten(value)
        kinds = set(map(type, leaves))
        if self.unknown and type(None) in kinds:
            leaves = [np.nan if leaf is None else leaf for leaf in leaves]
            kinds.discard(type(None))
        whole = self.dtype == "i8"
        wanted = (int, np.integer) if whole else (int, float, np.integer, np.floating)
        bad = {kind for kind in kinds if kind is bool or not issubclass(kind, wanted)}
        if bad:
            at = next(i for i, leaf in enumerate(leaves) if type(leaf) in bad)
            raise invalid(_element(at, shape), "an integer" if whole else "a number", leaves[at])
        try:
            return np.array(leaves, dtype="i8" if whole else "f8").reshape(shape)
        except OverflowError:  # an integer beyond what the array can hold: say which
            at = next(i for i, leaf in enumerate(leaves) if not self.low <= leaf <= self.high)
            raise invalid(_element(at, shape), self.range_described, leaves[at]) from None

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

    def _canonical(self, array: NDArray[Any]) -> NDArray[Any]:
        self.check_shape(array.shape)
        if self.wider:
            array = array[:, : self.shape[-1]]
        flags = array.flags
        if array.dtype != _DTYPES[self.dtype] or not (flags.c_contiguous and flags.aligned):
            array = self._converted(array)
        if array.flags.writeable or type(array) is not np.ndarray:
            array = array.view(np.ndarray)
            array.flags.writeable = False
        return array

    def _converted(self, array: NDArray[Any]) -> NDArray[Any]:
        whole = self.dtype == "i8"
        if array.dtype.kind not in ("iu" if whole else "fiu"):
            expected = f"an array of {'integers' if whole else 'numbers'}"
            raise MessageError("invalid_value", "", expected, cut(f"an array of {array.dtype}"))
        if whole and array.size and array.max() > self.high:  # before the conversion, which would wrap around
            at = int(array.argmax())
            raise invalid(_element(at, array.shape), self.range_described, array.reshape(-1)[at])
        with np.errstate(over="ignore"):  # what overflows becomes infinite, and the range check names it
            return np.array(array, self.dtype, order="C")

    def _check_values(self, array: NDArray[Any]) -> None:
        lowest, highest = np.minimum.reduce(array, axis=None), np.maximum.reduce(array, axis=None)
        # Both extremes of an array with a NaN are NaN, and comparisons with NaN are false.
        if (lowest > self.low if self.above else lowest >= self.low) and highest <= self.high:
            return
        good = ((array > self.low) if self.above else (array >= self.low)) & (array <= self.high)
        if self.unknown:
            good |= np.isnan(array).all(axis=-1, keepdims=True)
        if not good.all():
            at = int(np.argmin(good))
            raise invalid(_element(at, array.shape), self.range_described, array.reshape(-1)[at])

    def to_lists(self, array: NDArray[Any]) -> list[Any]:
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
    return None if value != value else value  # noqa: PLR0124 - NaN


def unit_quaternion(array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `array` (4,), w x y z, when its norm is within 0.001 of one, so that float32 sources pass."""
    norm = float(np.sqrt(array @ array))
    if abs(norm - 1.0) > 1e-3:  # noqa: PLR2004 - the tolerance of the description
        raise MessageError("invalid_value", "", "a unit quaternion w, x, y, z", f"one of norm {norm:.6g}")
    return array


def _element(at: int, shape: tuple[int, ...]) -> str:
    """Return the path of the element number `at` of an array: `[7][1]`; empty for an array without dimensions."""
    return "".join(f"[{int(i)}]" for i in np.unravel_index(at, shape)) if shape else ""
