"""What all tests share: interrupts as in a terminal, an end that nothing delays, and tests with their own command."""

import faulthandler
import gc
import os
import random
import signal
import sys
from collections.abc import Generator
from pathlib import Path

import forked
import guard
import hypothesis
import pytest
from hypothesis.internal.conjecture import providers

HERE = Path(__file__).parent

# Background processes of a shell ignore it, and their children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

forked.ALLOWED = True
guard.begin()

OTHERS = {
    "alone": ("clients/test_long_tables.py", "e2e/test_cluster.py", "e2e/test_load.py", "e2e/test_soak.py"),
    "accuracy": (
        "clients/test_accuracy_gaps.py",
        "clients/test_accuracy_kitti.py",
        "clients/test_accuracy_nuscenes.py",
    ),
}
"""Files whose tests `make test` leaves to `make alone` and `make accuracy`, by their marker."""

MACHINE_CODE = ("tracker/test_prepared.py", "tracker/test_returned_arrays.py", "tracker/test_warm_up.py")
"""Files about compilation, which are left out where there is none."""

PLAIN = os.environ.get("NUMBA_DISABLE_JIT") == "1"
"""Whether kernels run as Python."""

ORDER = os.environ.get("OPTIPMB_TEST_ORDER", "")
"""Seed of a random order; empty: the order in which all tests take the least time."""

WAITING = ("docker", "e2e", "grpc", "service")
"""Folders whose tests mostly start processes and wait for them."""

# The same thirty examples in every run, unless a test says otherwise; `--hypothesis-profile default` looks at more.
# Kernels as Python take a hundred times as long.
EXAMPLES = 3 if PLAIN else 30
hypothesis.settings.register_profile("same", derandomize=True, deadline=None, database=None, max_examples=EXAMPLES)
hypothesis.settings.load_profile("same")
# It also draws constants of the modules that are loaded, and those depend on the tests that a process ran before. There
# is no setting for it.
providers.is_local_module_file = lambda _path: False


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Take what all tests import out of the garbage collector's sight: it would walk it again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if ORDER:
        _shuffle(items)
    else:
        _interleave(items)
    marker_of = {HERE / name: marker for marker, names in OTHERS.items() for name in names}
    left_out = {HERE / name for name in MACHINE_CODE} if PLAIN else set()
    for item in items:
        if item.path in marker_of:
            item.add_marker(marker_of[item.path])
        if item.path in left_out:
            item.add_marker(pytest.mark.skip(reason="nothing is compiled"))


def pytest_report_teststatus(report: pytest.CollectReport | pytest.TestReport) -> tuple[str, str, str] | None:
    """Name a test where it fails, not at the end of the run alone, which may be cut."""
    if not report.failed:
        return None
    category = "failed" if report.when == "call" else "error"
    return category, f"\n{category.upper()} {report.nodeid}\n", category.upper()


def _interleave(items: list[pytest.Item]) -> None:
    """Alternate files that start processes and wait with files that compute, from first to last."""
    waiting, computing = {}, {}
    for item in items:
        folder = item.path.relative_to(HERE).parts[0]
        (waiting if folder in WAITING else computing).setdefault(item.path, None)
    place = {path: number / len(waiting) for number, path in enumerate(waiting)}
    place |= {path: number / len(computing) for number, path in enumerate(reversed(computing))}
    items.sort(key=lambda item: place[item.path])


def _shuffle(items: list[pytest.Item]) -> None:
    """Put the files in a random order, and the tests of each, which may share what is made for their file."""
    chance = random.Random(ORDER)
    place = {path: chance.random() for path in sorted({item.path for item in items})}
    items.sort(key=lambda item: (place[item.path], chance.random()))


def pytest_unconfigure() -> None:
    """Bound the end of the process, which waits for threads of tests that failed; their stacks are printed then."""
    faulthandler.dump_traceback_later(60, exit=True, file=sys.__stderr__)
