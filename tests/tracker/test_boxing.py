"""How kernels give arrays away: as numba does, but for the way in which it finds the class of an array."""

from __future__ import annotations

import resource
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

import optipmb
from optipmb.compiled import kernel

if TYPE_CHECKING:
    from types import FrameType

    from numpy.typing import NDArray

PARAMETERS = optipmb.load_profile("generic")


@kernel
def made(count: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_], NDArray[np.float64]]:
    """Return arrays of several types, a view among them."""
    numbers = np.arange(6.0 * count).reshape(count, 6)
    return numbers, np.arange(count), np.arange(count) % 2 == 0, numbers[1:, ::2]


@kernel
def returned(given: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what was given."""
    return given


def frame(stamp_ns: int) -> optipmb.Frame:
    """A frame with two objects."""
    return optipmb.make_frame(
        PARAMETERS,
        stamp_ns=stamp_ns,
        labels=PARAMETERS.labels[:1],
        label=[0, 0],
        center=[[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]],
        size=[[4.0, 2.0, 1.5]] * 2,
        yaw=[0.0, 1.0],
        score=[0.9, 0.8],
    )[0]


def test_arrays_are_what_plain_python_makes() -> None:
    """Class, type, shape, strides, numbers and writability are those of the same arrays made without a kernel."""
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
    """A view keeps the memory that it shows, and the memory of arrays that nobody has any more is used again."""
    view = made(1000)[3]
    before, classes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, sys.getrefcount(np.ndarray)
    for _ in range(2000):
        made(20_000)  # a megabyte
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown_kb < 200_000
    assert sys.getrefcount(np.ndarray) - classes < 100
    assert np.array_equal(view, np.arange(6000.0).reshape(1000, 6)[1:, ::2])


def test_a_step_looks_for_no_class() -> None:
    """No array that a step returns costs a call of numba's interpreted function, with the numba that is installed."""
    tracker, density, called = optipmb.Tracker(PARAMETERS), optipmb.Tracker(PARAMETERS).initial(), []
    for number in range(3):
        density = tracker.step(density, frame(number * 10**8)).density

    def watch(one: FrameType, event: str, _: Any) -> None:
        if event == "call":
            called.append(one.f_code.co_name)

    sys.setprofile(watch)
    try:
        tracks = tracker.step(density, frame(3 * 10**8)).tracks
    finally:
        sys.setprofile(None)
    assert len(tracks.id) == 2
    assert "step" in called
    assert "_numba_unpickle" not in called
