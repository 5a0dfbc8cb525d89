"""How kernels are compiled: once, to disk, without the interpreter lock, and with IEEE arithmetic.

``fastmath`` stays off, so that the same input gives the same bytes on every run; ``parallel`` stays off, so that a
service may run many streams side by side without threads inside a frame. Division by zero follows IEEE
(``error_model="numpy"``): kernels guard their divisors themselves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar, cast

import numba

if TYPE_CHECKING:
    from collections.abc import Callable

    F = TypeVar("F", bound=Callable[..., object])
else:
    F = TypeVar("F")


def kernel(function: F) -> F:
    """Compile `function` with numba at its first call; later processes load the machine code from beside the source."""
    return cast("F", numba.njit(cache=True, nogil=True, error_model="numpy")(function))
