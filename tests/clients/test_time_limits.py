"""Waits with a limit, on a clock that only they move: none is longer than what is left, and together they fill it."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
import optipmb_client.grpc.channels
import optipmb_service.app.storage
import optipmb_service.edges.ros2.work
import optipmb_tools.recordings.record
import optipmb_tools.run.replay
import pytest
from optipmb_client import ConnectionFailed
from optipmb_service.app.configuration import load
from optipmb_service.cluster.store import StoreError

LIMIT_S = 7.3


class Clock:
    """Time that passes in waits alone."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 100.0
        self.waits: list[float] = []
        self.monkeypatch = monkeypatch

    def of(self, module: Any) -> None:
        """Be the clock of a module."""
        self.monkeypatch.setattr(
            module, "time", SimpleNamespace(**vars(time) | {"monotonic": lambda: self.now_s, "sleep": self.wait})
        )

    def wait(self, seconds: float) -> bool:
        """Let time pass in vain."""
        self.waits.append(seconds)
        self.now_s += seconds
        return False


def connecting(clock: Clock, _folder: Path) -> None:
    """Wait for gateways that never answer."""

    def result(seconds: float) -> None:
        clock.wait(seconds)
        raise grpc.FutureTimeoutError

    clock.of(optipmb_client.grpc.channels)
    clock.monkeypatch.setattr(grpc, "channel_ready_future", lambda _: SimpleNamespace(result=result))
    with pytest.raises(ConnectionFailed, match="no gRPC gateway answers at a:1, b:1"):
        optipmb_client.grpc.channels.Channels(("a:1", "b:1"), None, {}, LIMIT_S)


def replaying(clock: Clock, _folder: Path) -> None:
    """Receive until the next frame is due."""
    link: Any = SimpleNamespace(subscribe_streams=lambda *_, **__: None)
    module = optipmb_tools.run.replay
    exchange = module.Exchange("a/b/c", link, 1, pace=module.ReplayPace(), prefix="optipmb", on_frame=lambda: None)
    clock.of(module)
    clock.monkeypatch.setattr(exchange, "subscriber", SimpleNamespace(receive=lambda s: clock.wait(s) or None))
    assert exchange.until(clock.now_s + LIMIT_S)


def recording(clock: Clock, folder: Path) -> None:
    """Record for a duration."""
    handle = SimpleNamespace(close=lambda: None)
    connection: Any = SimpleNamespace(subscribe=lambda *_: handle, query=lambda *_, **__: iter(()))
    stop: Any = SimpleNamespace(is_set=lambda: False, wait=clock.wait, set=lambda: None)
    clock.of(optipmb_tools.recordings.record)
    wanted = optipmb_tools.recordings.record.Wanted(["a/b/c"], points=False, duration=LIMIT_S, prefix="optipmb")
    optipmb_tools.recordings.record.record(connection, folder / "a.mcap", wanted, stop=stop)


def working(clock: Clock, _folder: Path) -> None:
    """Handle messages of ROS 2 while none come."""
    node: Any = SimpleNamespace(endpoint=lambda *about: about, client=None)
    work = optipmb_service.edges.ros2.work.Work(load(None, {"store": "none"}).settings, node)
    clock.of(optipmb_service.edges.ros2.work)
    clock.monkeypatch.setattr(work, "_filled", SimpleNamespace(wait=clock.wait, clear=lambda: None))
    clock.monkeypatch.setattr(work, "_diagnose", lambda: None)
    work.work(LIMIT_S)


def starting(clock: Clock, _folder: Path) -> None:
    """Wait for a store that is not reached, to copy checkpoints to it."""

    def follow(_: int) -> None:
        raise StoreError("no server")

    clock.of(optipmb_service.app.storage)
    clock.monkeypatch.setattr(optipmb_service.app.storage, "REACH_S", LIMIT_S)
    store: Any = SimpleNamespace(follow=follow)
    with pytest.raises(StoreError, match="no server"):
        optipmb_service.app.storage._reach(store)


@pytest.mark.parametrize(
    ("waits", "step_s"),
    [
        (connecting, LIMIT_S / 2),
        (replaying, optipmb_tools.run.replay.TICK_S),
        (recording, optipmb_tools.recordings.record.FLUSH_S),
        (working, optipmb_service.edges.ros2.work.TICK_S),
        (starting, optipmb_service.app.storage.AGAIN_S),
    ],
)
def test_a_limit_is_waited_for_and_no_longer(
    waits: Callable[[Clock, Path], None], step_s: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The waits fill the limit, in steps of their length and none beyond what is left."""
    clock = Clock(monkeypatch)
    waits(clock, tmp_path)
    assert clock.now_s - 100.0 == pytest.approx(LIMIT_S, abs=0.1)
    assert max(clock.waits) <= step_s
    assert len(clock.waits) <= 2 + LIMIT_S / step_s


def test_a_store_that_comes_late_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first answer ends the wait."""
    answers: Iterator[bool] = iter([False, False, True])

    def follow(_: int) -> None:
        if not next(answers):
            raise StoreError("no server")

    clock = Clock(monkeypatch)
    clock.of(optipmb_service.app.storage)
    store: Any = SimpleNamespace(follow=follow)
    optipmb_service.app.storage._reach(store)
    assert len(clock.waits) == 2
