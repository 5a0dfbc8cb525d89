"""What all tests share: interrupts as in a terminal, and which tests have the machine for themselves."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest

HERE = Path(__file__).parent

# What a shell starts in the background ignores it, and hands that on to what it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)

ALONE = (
    "docker",
    "e2e",
    "service/test_command.py",
    "service/test_durable.py",
    "service/test_http.py",
    "service/test_live_page.py",
    "service/test_memory.py",
    "service/test_moves.py",
    "service/test_network.py",
    "service/test_private.py",
)
"""Folders and files whose tests watch processes, memory and clocks (`-m alone`); what only computes runs two by two."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that run alone."""
    alone = [HERE / name for name in ALONE]
    for item in items:
        if any(item.path.is_relative_to(one) for one in alone):
            item.add_marker("alone")
