"""Records that a step takes, passes from stage to stage and returns. Their fields are never assigned to.

The columns of `Rows` lie one behind the other in one array, which kernels take and return. Each array that a kernel
returns is an object of numpy; creating and releasing the 19 columns of a density took a tenth of the time of a frame of
40 objects. A column is a view of the array, made when it is read.

A `record` is a dataclass that the type checker freezes. At run time a frozen one stores each field through
`object.__setattr__`: a step of ten objects, which fills about ninety fields, would spend a fifth of its time there.
"""

from __future__ import annotations

import sys
from collections import namedtuple
from dataclasses import dataclass, field
from math import nan, prod
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, Self, TypeAlias, TypeVar, dataclass_transform, overload

import numpy as np

from optipmb.compiled import kernel
from optipmb.model.errors import DensityError, OptipmbError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

_N = TypeVar("_N", bound=np.generic)
_R = TypeVar("_R", bound="Rows")

_LOWEST: Final = 0 if sys.byteorder == "little" else 7
"""Byte of an integer that holds a flag."""


class Column(Generic[_N]):
    """A column of a record, (N, *shape): a view of its array.

    A number takes 8 bytes, and a flag is the integer 0 or 1.

    Args:
        number: float64, int64 or bool.
        shape: of a row.
        low, high: range of the numbers, both ends included; NaN: any number.
    """

    def __init__(self, number: type[_N], *shape: int, low: float = nan, high: float = nan) -> None:
        self.number = np.dtype(number)
        self.kind = self.number.kind
        self.shape = shape
        self.low, self.high = low, high
        self.begin = self.end = 0

    def __set_name__(self, record: type[Rows], name: str) -> None:
        """Take the place behind the columns before."""
        self.begin = record.width
        self.end = record.width = self.begin + prod(self.shape)
        record.described = {**record.described, name: self}

    @overload
    def __get__(self, rows: None, record: type[Rows]) -> Self: ...

    @overload
    def __get__(self, rows: Rows, record: type[Rows]) -> NDArray[_N]: ...

    def __get__(self, rows: Rows | None, record: type[Rows]) -> Self | NDArray[_N]:
        """Return the view."""
        if rows is None:
            return self
        words = rows.words
        count = len(words) // record.width
        part: NDArray[Any] = words[self.begin * count : self.end * count]
        if self.kind == "i":
            part = part.view(INDEX)
        elif self.kind == "b":
            part = part.view(np.bool_)[_LOWEST::8]
        return part.reshape(count, *self.shape) if self.shape else part


class Rows:
    """A record of columns of equal length.

    Args:
        columns: all of them by name, which are copied.

    Raises:
        OptipmbError: one is missing, is no array of its number type and shape, or has another length.
    """

    part: ClassVar[str]
    """Name of the record in the paths of errors."""
    refused: ClassVar[type[OptipmbError]] = DensityError
    """Type of these errors."""
    width: ClassVar[int] = 0
    """Words of 8 bytes that a row takes."""
    described: ClassVar[dict[str, Column[Any]]] = {}
    """The columns by name, in the order in which they lie in `words`."""

    __slots__ = ("words",)

    words: NDArray[np.float64]
    """(N * width,) the columns, one behind the other; integers and flags as their bytes."""

    def __init__(self, **columns: NDArray[Any]) -> None:
        count: int | None = None
        for name, one in self.described.items():
            column: object = columns.get(name)
            path = f"{self.part}.{name}"
            wanted = one.number, one.shape, 1 + len(one.shape)
            if not isinstance(column, np.ndarray) or (column.dtype, column.shape[1:], column.ndim) != wanted:
                shape = ", ".join(map(str, ("N", *one.shape)))
                raise self.refused(path, f"({shape}) {one.number}", shown(column))
            count = len(column) if count is None else count
            if len(column) != count:
                raise self.refused(path, f"{count} rows", shown(column))
        if unknown := sorted(columns.keys() - self.described.keys()):
            raise self.refused(self.part, f"the columns {', '.join(self.described)}", ", ".join(unknown))
        self.words = np.zeros((count or 0) * self.width)
        for name, column in columns.items():
            getattr(self, name)[...] = column

    @classmethod
    def of(cls, words: NDArray[np.float64]) -> Self:
        """Return the record of an array that a kernel has made."""
        rows = object.__new__(cls)
        rows.words = words
        return rows

    @classmethod
    def empty(cls) -> Self:
        """Return a record without rows."""
        return cls.of(np.zeros(0))

    def __len__(self) -> int:
        return len(self.words) // self.width

    def columns(self) -> Iterator[tuple[str, NDArray[Any]]]:
        """Yield the name and the array of each column."""
        for name in self.described:
            yield name, getattr(self, name)

    def replaced(self, **columns: NDArray[Any]) -> Self:
        """Return a record with other columns of these names.

        Raises:
            OptipmbError: they do not fit.
        """
        return type(self)(**dict(self.columns()) | columns)

    def take(self, rows: NDArray[np.generic]) -> Self:
        """Return the rows that an index array or a mask selects."""
        return type(self)(**{name: column[rows] for name, column in self.columns()})


def arrays_of(record: type[Rows], name: str, module: str) -> Any:
    """Return the named tuple in which kernels have the columns of a record, a constant of a module by that name."""
    return namedtuple(name, [*record.described], module=module)  # noqa: PYI024 - a class would list the columns of the record again


def views_of(record: type[_R], arrays: Any, name: str, file: str) -> Callable[[Array], _R]:
    """Return the kernel that takes `words` of a record and returns its columns, which are views; flags are 0 and 1.

    Args:
        record: the record.
        arrays: the named tuple of its columns, by `arrays_of`.
        name: of the kernel, a constant of the same module.
        file: of the module: numba keeps the machine code in its folder.
    """
    views = []
    for one in record.described.values():
        shape = f".reshape(n, {', '.join(map(str, one.shape))})" if one.shape else ""
        views.append(f"{'words' if one.kind == 'f' else 'whole'}[{one.begin} * n : {one.end} * n]{shape}")
    lines = f"n = words.shape[0] // {record.width}", "whole = words.view(integer)", f"return arrays({', '.join(views)})"
    names = {"__name__": arrays.__module__, "arrays": arrays, "integer": np.int64}
    exec(compile(f"def {name}(words):\n    " + "\n    ".join(lines), file, "exec"), names)  # noqa: S102 - as `namedtuple` does
    views_in: Callable[[Array], _R] = kernel(names[name])
    return views_in


def shown(column: object) -> str:
    """Describe a column for the message of an error."""
    return f"{column.shape} {column.dtype}" if isinstance(column, np.ndarray) else type(column).__name__


T = TypeVar("T")

Array: TypeAlias = "NDArray[np.float64]"
Index: TypeAlias = "NDArray[np.int64]"

Columns: TypeAlias = Any
"""The columns of a named tuple in their order, as a plain tuple: what kernels take and return in its place.

Numba reads all names of a named tuple in every call, which doubles the time of the call. A kernel that takes columns
names them first, as `Measurements(*measurements)`.
"""

INDEX: Final = np.dtype(np.int64)
FLOAT: Final = np.dtype(np.float64)
"""Types of columns. Given to `np.empty` so, an array takes three quarters of the time that it takes by `np.int64`."""


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def record(cls: type[T]) -> type[T]:
    """Make a class a dataclass with slots whose fields are assigned by its constructor alone."""
    return dataclass(slots=True)(cls)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Make an array read-only: what a frame or a pose has can be shared, and is one type for the kernels."""
    array.flags.writeable = False
    return array
