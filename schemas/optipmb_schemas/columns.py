"""Named arrays as plain maps of array blocks, for files in which messages are kept together with other arrays."""

from collections.abc import Mapping
from functools import lru_cache
from math import prod
from typing import TYPE_CHECKING, Any, Final

from optipmb_schemas.errors import MessageError, invalid

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DTYPES: Final = {"f8": "<f8", "i8": "<i8", "b1": "?"}
MAX_DIMENSIONS: Final = 4


def pack_columns(columns: Mapping[str, "NDArray[Any]"]) -> dict[str, dict[str, Any]]:
    """Return named arrays of float64, int64 or bool as blocks; equal arrays give equal blocks."""
    packed: dict[str, dict[str, Any]] = {}
    for name, column in columns.items():
        dtype, little = _form(column.dtype)
        data = column.astype(little, copy=False).tobytes()
        packed[name] = {"dtype": dtype, "shape": list(column.shape), "data": data}
    return packed


@lru_cache(16)
def _form(dtype: "np.dtype[Any]") -> "tuple[str, np.dtype[Any]]":
    """Return the name of a number type in blocks, and the type in the byte order that they have."""
    return f"{dtype.kind}{dtype.itemsize}", dtype.newbyteorder("<")


def read_columns(value: object) -> "dict[str, NDArray[Any]]":
    """Return the named arrays of blocks, read-only.

    Raises:
        MessageError: with the path of the block, when one is not well formed.
    """
    if not isinstance(value, dict):
        raise invalid("", "a map of array blocks", value)
    return {str(name): _read(str(name), block) for name, block in value.items()}


def _read(name: str, block: object) -> "NDArray[Any]":
    import numpy as np  # noqa: PLC0415  messages alone need no numpy

    if not isinstance(block, dict):
        raise invalid(name, "an array block", block)
    kind, shape, data = block.get("dtype"), block.get("shape"), block.get("data")
    if not isinstance(kind, str) or kind not in DTYPES:
        raise invalid(f"{name}.dtype", f"one of {', '.join(DTYPES)}", kind)
    dtype = np.dtype(DTYPES[kind])
    if not isinstance(shape, list) or not 0 < len(shape) <= MAX_DIMENSIONS:
        raise invalid(f"{name}.shape", f"a list of 1 to {MAX_DIMENSIONS} lengths", shape)
    if not all(type(length) is int and 0 <= length < 2**31 for length in shape):
        raise invalid(f"{name}.shape", "a list of lengths", shape)
    if not isinstance(data, bytes) or len(data) != prod(shape) * dtype.itemsize:
        raise MessageError("invalid_value", f"{name}.data", f"{prod(shape) * dtype.itemsize} bytes", "others")
    if kind == "b1" and max(data, default=0) > 1:
        raise MessageError("invalid_value", f"{name}.data", "zeros and ones", "others")
    return np.frombuffer(data, dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
