"""The thread of the bridge to ROS 2: messages, and timers."""

import time
from types import SimpleNamespace
from typing import Any

import pytest
from optipmb_service.app.ros2 import _Work
from optipmb_service.settings import load

HANGS_S = 30.0


def test_more_than_can_be_handled_keeps_nothing_waiting_that_is_due(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where each message is followed by the next, diagnostics are sent and the work returns in its time."""
    node: Any = SimpleNamespace(endpoint=lambda *about: about, client=None)
    work = _Work(load(None, {"store": "none"}).settings, node)
    diagnosed: list[float] = []
    monkeypatch.setattr(work, "_diagnose", lambda: diagnosed.append(time.monotonic()))
    gives_up = time.monotonic() + HANGS_S

    def handle() -> None:
        if time.monotonic() < gives_up:
            work._put(handle)

    work._put(handle)
    work.work(0.05)
    assert diagnosed
    assert work._queue
    work.work(0.05)
    assert time.monotonic() < gives_up
