"""Records whose columns lie one behind the other in one array: what a density keeps, and kernels take and return.

Each array that a kernel returns is an object of numpy with memory of its own. A session that keeps the states of the
last second keeps a column long, and to make it and to let it go takes two microseconds: the 19 columns of a density
took a tenth of the time of a frame of 40 objects. So a record is one array, and a column is a view of it, made when
somebody reads it.
"""

from __future__ import annotations

import sys
from collections import namedtuple
from math import prod
from typing import TYPE_CHECKING, Any, ClassVar, Final, Generic, Self, TypeVar, overload

import numpy as np

from optipmb.errors import DensityError, OptipmbError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_N = TypeVar("_N", bound=np.generic)

_LOWEST: Final = 0 if sys.byteorder == "little" else 7
"""Which byte of an integer is that of a flag."""


class Column(Generic[_N]):
    """A column of a record, (N, *shape): a view of its array.

    A number takes 8 bytes, and a flag is the integer 0 or 1.

    Args:
        number: float64, int64 or bool.
        shape: of a row.
    """

    def __init__(self, number: type[_N], *shape: int) -> None:
        self.number = np.dtype(number)
        self.shape = shape
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
        words, count = rows.words, len(rows)
        part: NDArray[Any] = words[self.begin * count : self.end * count]
        if self.number == np.int64:
            part = part.view(np.int64)
        elif self.number == np.bool_:
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
        """Return the record of an array that a kernel has made of it."""
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


def shown(column: object) -> str:
    """Return what a column is, for the message of an error."""
    return f"{column.shape} {column.dtype}" if isinstance(column, np.ndarray) else type(column).__name__
