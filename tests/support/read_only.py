"""Arrays as a frame holds them."""

from typing import Any

from numpy.typing import NDArray


def read_only(*arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    """Make arrays read-only; a kernel that takes a frame's columns would be compiled once more for others."""
    for array in arrays:
        array.flags.writeable = False
    return arrays
