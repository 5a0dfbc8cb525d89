"""Records: what a step hands from stage to stage and gives away, dataclasses that nobody assigns to.

The type checker sees to it, as with frozen dataclasses. At run time those would store each field through
`object.__setattr__`, and a step of ten objects, which fills about ninety fields, would spend a fifth of its time there.
For the same reason a step gives the fields of the long records by position.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar, dataclass_transform

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

T = TypeVar("T")

Columns: TypeAlias = Any
"""The columns of a named tuple in their order, as a plain tuple: what kernels take and return in its place.

Numba reads all names of a named tuple in every call, which doubles the time of the call. A kernel that takes columns
names them first, as `Measurements(*measurements)`.
"""

INDEX: Final = np.dtype(np.int64)
"""Type of columns. Given to `np.empty` so, an array takes three quarters of the time that it takes by `np.int64`."""


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def record(cls: type[T]) -> type[T]:
    """Make a class a dataclass with slots whose fields are assigned by its constructor alone."""
    return dataclass(slots=True)(cls)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Make an array read-only: what a frame or a pose has can be shared, and is one type for the kernels."""
    array.flags.writeable = False
    return array
