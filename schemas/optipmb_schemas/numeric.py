"""Fields of numbers as numpy arrays.

A field always holds a numpy array of the number type of its description, in native byte order,
C-contiguous, aligned and read-only, so compiled code that is specialised on array types sees one type. An array that is
all this already is held as a view, without a copy.
"""

import array
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from optipmb_schemas.arrays import Array

WHOLE: Final = (int, np.integer)
REAL: Final = (int, float, np.integer, np.floating)
"""Types of the numbers in lists."""

_DTYPES: Final = {name: np.dtype("<" + name) for name in ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8")}


def given(value: object) -> NDArray[Any] | None:
    """Return an array or buffer as an array, and None for all else."""
    if isinstance(value, np.ndarray):
        return value
    return np.asarray(value) if isinstance(value, memoryview | array.array) else None


def of_leaves(leaves: list[Any], dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """Return numbers, row by row, as an array. OverflowError: one is beyond what the number type holds."""
    return np.array(leaves, dtype).reshape(shape)


def of_bytes(data: bytes | memoryview, dtype: str, shape: list[int]) -> NDArray[Any]:
    """Return little-endian numbers as an array: a view."""
    return np.frombuffer(data, _DTYPES[dtype]).reshape(shape) if data else np.empty(shape, _DTYPES[dtype])


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array, or a view of one that can be written to, that is read-only."""
    if array.flags.writeable:
        array = array.view(np.ndarray)
        array.flags.writeable = False
    return array


def canonical(array: NDArray[Any], description: "Array") -> NDArray[Any]:
    """Return an array, whose shape was checked, as a field holds it.

    Raises:
        MessageError: its numbers are of another kind, or do not fit.
    """
    if description.wider:
        array = array[:, : description.shape[-1]]
    flags = array.flags
    if array.dtype != _DTYPES[description.dtype] or not (flags.c_contiguous and flags.aligned):
        array = _converted(array, description)
    return read_only(array if type(array) is np.ndarray else array.view(np.ndarray))


def _converted(array: NDArray[Any], description: "Array") -> NDArray[Any]:
    whole = description.dtype == "i8"
    if array.dtype.kind not in ("iu" if whole else "fiu"):
        raise description.of_another_kind(array.dtype)
    if whole and array.size and array.max() > description.high:  # before the conversion, which would wrap around
        raise description.refused(int(array.argmax()), array)
    with np.errstate(over="ignore"):  # what overflows becomes infinite, and the range check names it
        return np.array(array, description.dtype, order="C")


def first_outside(array: NDArray[Any], description: "Array") -> int | None:
    """Return which number of a non-empty array is the first out of its range; None: none is."""
    low, high, above = description.low, description.high, description.above
    lowest, highest = np.minimum.reduce(array, axis=None), np.maximum.reduce(array, axis=None)
    # Both extremes of an array with a NaN are NaN, and comparisons with NaN are false.
    if (lowest > low if above else lowest >= low) and highest <= high:
        return None
    good = ((array > low) if above else (array >= low)) & (array <= high)
    if description.unknown:
        good |= unknown(array, description)
    return None if good.all() else int(np.argmin(good))


def unknown(array: NDArray[Any], description: "Array") -> NDArray[np.bool_]:
    """Return which numbers of an array, or rows with a last axis of length one, are NaN where that is allowed."""
    nan: NDArray[np.bool_] = np.isnan(array)
    if description.unknown == "row":
        nan = np.all(nan, axis=-1, keepdims=True)
    elif description.unknown == "last":
        nan[..., :-1] = False
    return nan


def finite(points: Any) -> Any:
    """Return x, y, z of the points whose coordinates are finite; other values as they are."""
    if not isinstance(points, np.ndarray) or points.ndim != 2 or points.dtype.kind != "f":  # noqa: PLR2004  a table: rows and columns
        return points
    xyz = np.ascontiguousarray(points[:, :3])
    good = np.isfinite(xyz)
    return xyz if good.all() else xyz[good[:, 0] & good[:, 1:].all(axis=1)]
