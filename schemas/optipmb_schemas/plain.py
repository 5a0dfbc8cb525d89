"""Fields of numbers without numpy: the names of `numeric`, over Python's own buffers. Tests hold the two equal."""

import array
import math
import operator
import struct
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final

from optipmb_schemas.errors import MessageError, cut

if TYPE_CHECKING:
    from optipmb_schemas.arrays import Array

WHOLE: Final = (int,)
REAL: Final = (int, float)

_CODES: Final = dict(zip(("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8"), "fdbhiqBHIQ", strict=True))
"""Number types of the wire, by the letters of `array` and `struct`."""

_FLOATS: Final = frozenset("fd")
_BUFFERS: Final = frozenset("bBhHiIlLqQ") | _FLOATS


class Numbers:
    """Numbers in rows, read-only: what a field holds where numpy is not installed.

    `len`, loops, `[i]`, `shape`, `tolist` and `tobytes` work as on a numpy array; a row of a table is again of
    this type. Further operations need numpy: `pip install numpy`.

    Args:
        flat: All numbers, row by row.
        shape: Numbers of rows, columns and so on.
    """

    __slots__ = ("flat", "shape")

    def __init__(self, flat: memoryview, shape: tuple[int, ...]) -> None:
        self.flat = flat.toreadonly()
        self.shape = shape

    @property
    def dtype(self) -> str:
        """Number type, by numpy's name."""
        code = self.flat.format
        return f"{'float' if code in _FLOATS else 'uint' if code.isupper() else 'int'}{8 * self.flat.itemsize}"

    @property
    def size(self) -> int:
        """Number of numbers."""
        return len(self.flat)

    def reshape(self, shape: tuple[int, ...]) -> "Numbers":
        """Return the same numbers in another shape."""
        return Numbers(self.flat, shape)

    def tobytes(self) -> bytes:
        """Return the numbers as they are in memory, row by row."""
        return self.flat.tobytes()

    def tolist(self) -> list[Any]:
        """Return the numbers as nested lists."""
        return self.flat.tolist() if len(self.shape) == 1 else [row.tolist() for row in self]

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, row: int) -> Any:
        try:
            at = operator.index(row)
        except TypeError:
            needs = "slices and several indices need numpy: pip install numpy"
            raise TypeError(needs) from None
        number = range(len(self))[at]
        if len(self.shape) == 1:
            return self.flat[number]
        width = math.prod(self.shape[1:])
        return Numbers(self.flat[number * width : (number + 1) * width], self.shape[1:])

    def __iter__(self) -> Iterator[Any]:
        return map(self.__getitem__, range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self.tobytes(), self.flat.format, self.shape)

    def __repr__(self) -> str:
        return f"Numbers({self.tolist()})"


ARRAY: Final = Numbers


def asarray(value: Any) -> Any:
    """Return buffers as arrays, and all else as it is."""
    found = given(value)
    return value if found is None else found


def given(value: object) -> Numbers | None:
    """Return an array or buffer as an array, and None for all else."""
    if isinstance(value, Numbers):
        return value
    if not isinstance(value, memoryview | array.array):
        return None
    view = memoryview(value)
    code = view.format.lstrip("<=@")
    if code not in _BUFFERS or view.itemsize != struct.calcsize(code):
        raise MessageError("invalid_value", "", "a buffer of numbers", cut(f"one of format {view.format}"))
    return Numbers(_flat(view.tobytes(), code), tuple(view.shape or ()))


def _rebuilt(data: bytes, code: str, shape: tuple[int, ...]) -> Numbers:
    return Numbers(_flat(data, code), shape)


def _flat(data: bytes | memoryview, code: str) -> memoryview:
    if not data:  # an empty buffer cannot be cast
        return memoryview(array.array(code))
    as_bytes: Any = memoryview(data).cast("B")
    flat: memoryview = as_bytes.cast(code)
    return flat


def of_leaves(leaves: list[Any], dtype: str, shape: tuple[int, ...]) -> Numbers:
    """Return numbers, row by row, as an array. OverflowError: one is beyond what the number type holds."""
    return Numbers(memoryview(array.array(_CODES[dtype], leaves)), shape)


def of_bytes(data: bytes | memoryview, dtype: str, shape: list[int]) -> Numbers:
    """Return little-endian numbers as an array: a view."""
    return Numbers(_flat(data, _CODES[dtype]), tuple(shape))


def memory_of(numbers: Numbers) -> memoryview:
    """Return the numbers of an array in memory, row by row."""
    return numbers.flat


def canonical(numbers: Numbers, description: "Array") -> Numbers:
    """Return an array, whose shape was checked, as a field holds it.

    Raises:
        MessageError: its numbers are of another kind, or do not fit.
    """
    columns = description.shape[-1]
    if description.wider and isinstance(columns, int):
        numbers = _columns(numbers, columns)
    code = _CODES[description.dtype]
    if numbers.flat.format == code:
        return numbers
    if description.dtype == "i8":
        if numbers.flat.format in _FLOATS:
            raise description.of_another_kind(numbers.dtype)
        if numbers.size and (most := max(numbers.flat)) > description.high:
            raise description.refused(numbers.flat.tolist().index(most), numbers)
    return Numbers(memoryview(array.array(code, numbers.flat.tolist())), numbers.shape)


def first_outside(numbers: Numbers, description: "Array") -> int | None:
    """Return which number of a non-empty array is the first out of its range; None: none is."""
    low, high, flat = description.low, description.high, numbers.flat
    if flat.format == "f":  # as numpy compares them
        low, high = array.array("f", (low, high))
    if description.above:
        outside = [at for at, value in enumerate(flat) if not low < value <= high]  # a NaN is never within
    else:
        outside = [at for at, value in enumerate(flat) if not low <= value <= high]
    width, kind = numbers.shape[-1], description.unknown
    if outside and kind == "row":
        outside = [at for at in outside if not all(map(math.isnan, flat[at - at % width :][:width]))]
    elif outside and kind:
        outside = [at for at in outside if not (math.isnan(flat[at]) and (kind == "number" or (at + 1) % width == 0))]
    return outside[0] if outside else None


def finite(points: Any) -> Any:
    """Return x, y, z of the points whose coordinates are finite; other values as they are."""
    if not (isinstance(points, Numbers) and len(points.shape) == 2 and points.flat.format in _FLOATS):  # noqa: PLR2004  a table: rows and columns
        return points
    xyz = _columns(points, 3)
    flat, width = xyz.flat, xyz.shape[1]
    if all(map(math.isfinite, flat)):
        return xyz
    kept = array.array(flat.format)
    for at in range(0, len(flat), width):
        if all(map(math.isfinite, flat[at : at + width])):
            kept.extend(flat[at : at + width])
    return Numbers(memoryview(kept), (len(kept) // width, width))


def _columns(table: Numbers, width: int) -> Numbers:
    """Return the first columns of a table."""
    rows, columns = table.shape
    if columns <= width:
        return table
    chosen = array.array(table.flat.format, bytes(rows * width * table.flat.itemsize))
    for column in range(width):
        chosen[column::width] = array.array(table.flat.format, table.flat[column::columns].tolist())
    return Numbers(memoryview(chosen), (rows, width))


def of_each_matrix(function: Callable[[Any], bool], matrices: Numbers) -> list[bool]:
    """Return what a function of the elements of a matrix gives for each of (M, rows, columns)."""
    return [function(matrix.tolist()) for matrix in matrices]
