"""Arrays that kernels return equal arrays of plain Python, and live as long."""

from __future__ import annotations

import resource
from typing import TYPE_CHECKING, Any

import numpy as np

from optipmb.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray


@kernel
def made(count: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_], NDArray[np.float64]]:
    """Return arrays of several types, a view among them."""
    numbers = np.arange(6.0 * count).reshape(count, 6)
    return numbers, np.arange(count), np.arange(count) % 2 == 0, numbers[1:, ::2]


@kernel
def returned(given: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the argument."""
    return given


def test_arrays_are_what_plain_python_makes() -> None:
    """Class, type, shape, strides, numbers and writability equal those without a kernel."""
    plain: Any = made
    for ours, theirs in zip(made(5), plain.py_func(5), strict=True):
        assert type(ours) is np.ndarray
        assert (ours.dtype, ours.shape, ours.strides) == (theirs.dtype, theirs.shape, theirs.strides)
        assert ours.flags.writeable
        assert np.array_equal(ours, theirs)


def test_an_array_that_was_given_comes_back() -> None:
    """It is the same object, not another view of it."""
    given = np.arange(3.0)
    assert returned(given) is given


def test_an_array_lives_as_long_as_it_is_used_and_no_longer() -> None:
    """A view keeps the memory that it shows, and the memory of released arrays is used again."""
    view = made(1000)[3]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(2000):
        made(20_000)  # a megabyte
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown_kb < 200_000
    assert np.array_equal(view, np.arange(6000.0).reshape(1000, 6)[1:, ::2])
