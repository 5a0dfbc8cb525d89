"""What all tests share: interrupts as in a terminal, and which tests have the machine for themselves."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis

if TYPE_CHECKING:
    import pytest

HERE = Path(__file__).parent

# What a shell starts in the background ignores it, and hands that on to what it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)

ALONE = ("e2e/test_load.py", "e2e/test_soak.py")
"""Files whose tests measure memory and times (`-m alone`); all others wait for conditions and run side by side."""

# The same examples in every run; `--hypothesis-profile default` looks at others.
hypothesis.settings.register_profile("same", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("same")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that run alone."""
    alone = [HERE / name for name in ALONE]
    for item in items:
        if any(item.path.is_relative_to(one) for one in alone):
            item.add_marker("alone")
