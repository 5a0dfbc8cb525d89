"""Times of tasks that are compared, taken in turns: what else the machine does meets all of them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

ROUNDS = 30
CALLS = 10
Times = dict[str, np.ndarray]
CLOCK = time.thread_time_ns
"""Processor time of this thread: what else the machine does is not in it, but for the caches that it empties."""


def in_turns(tasks: dict[str, Callable[[], object]], rounds: int = ROUNDS, calls: int = CALLS) -> Times:
    """Milliseconds of every call of every task, a few calls of each in turn."""
    spent: dict[str, list[int]] = {name: [] for name in tasks}
    for task in tasks.values():
        task()
    for _ in range(rounds):
        for name, task in tasks.items():
            for _ in range(calls):
                begun = CLOCK()
                task()
                spent[name].append(CLOCK() - begun)
    return {name: np.array(times) / 1e6 for name, times in spent.items()}


def summary(times: np.ndarray) -> dict[str, float]:
    """Median, 99th percentile and smallest of milliseconds."""
    return {"median": float(np.median(times)), "p99": float(np.percentile(times, 99)), "least": float(times.min())}
