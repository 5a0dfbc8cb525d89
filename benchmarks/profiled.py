"""Shares of a step: arithmetic, calls of kernels, interpreter and numpy.

Each dispatcher of a kernel that the tracker calls is replaced by a function that reads a clock before and after. A
kernel's time is its call less the cost of calling a kernel with the same arguments, measured with one that does
nothing.
"""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb

STEPS = 200


@numba.njit
def nothing(*arrays: Any) -> int:
    """Do nothing, with such arguments."""
    return len(arrays)


def cost_of_a_call(arguments: tuple[Any, ...]) -> float:
    """Nanoseconds to call a kernel with such arguments, without its return value."""
    spent = []
    nothing(*arguments)
    for _ in range(300):
        begun = time.thread_time_ns()
        nothing(*arguments)
        spent.append(time.thread_time_ns() - begun)
    return float(np.median(spent))


def shares(tracker: optipmb.Tracker, density: optipmb.Density, frame: optipmb.Frame) -> dict[str, float]:
    """Median microseconds per step: in kernels, in calling them, and the rest."""
    spent = 0
    calls: list[tuple[Any, ...]] = []

    def clocked(function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            nonlocal spent
            begun = time.thread_time_ns()
            result = function(*arguments)
            spent += time.thread_time_ns() - begun
            calls.append(arguments)
            return result

        return timed

    modules = [module for name, module in sys.modules.items() if name.startswith("optipmb.")]
    replaced = [(m, n, v) for m in modules for n, v in vars(m).items() if isinstance(v, Dispatcher)]
    plain = []
    for _ in range(STEPS):
        begun = time.thread_time_ns()
        tracker.step(density, frame)
        plain.append(time.thread_time_ns() - begun)
    rows = []
    try:
        for module, name, function in replaced:
            setattr(module, name, clocked(function))
        for _ in range(STEPS):
            spent = 0
            calls.clear()
            tracker.step(density, frame)
            rows.append(spent)
    finally:
        for module, name, function in replaced:
            setattr(module, name, function)
    in_calls = float(np.median(rows))
    calling = min(sum(cost_of_a_call(arguments) for arguments in calls), in_calls)
    total = float(np.median(plain))
    return {
        "kernels": (in_calls - calling) / 1e3,
        "calls": calling / 1e3,
        "python": max(total - in_calls, 0.0) / 1e3,
    }
