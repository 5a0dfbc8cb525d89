"""What saved figures say of the machine: its processor and software, not its name."""

from __future__ import annotations

from typing import Any


def pytest_benchmark_update_machine_info(machine_info: dict[str, Any]) -> None:
    """Leave out the name of the machine."""
    machine_info.pop("node", None)
