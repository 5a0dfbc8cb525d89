"""What is read of the log for a session is bounded, and the newest of it is given."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import pytest
from nats_process import NatsProcess
from optipmb_service.cluster import log_reader
from optipmb_service.cluster.log_position import Missed, Position
from optipmb_service.cluster.log_reader import LogReader
from optipmb_service.cluster.message_log import LogMessage, MessageLog, Retention
from router import until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

STREAM = "a/b/c"
EPOCH = bytes(16)
FRAMES = 20
TRACKED = 4
LAST_TRACKED = Missed((STREAM,), "", lambda _: False, {STREAM: Position(frozenset(), EPOCH, TRACKED, tracked=True)})


@pytest.fixture
def filled(tmp_path: Path) -> Iterator[MessageLog]:
    """A log with frames of one stream."""
    with NatsProcess(tmp_path) as nats:
        one = MessageLog([nats.url], "optipmb/v1")

        async def fill() -> None:
            await one.ready("detections", Retention(600, 2**24))
            for seq in range(FRAMES):
                await one.put(LogMessage("detections", STREAM, EPOCH, seq, seq, "", (0, 0), bytes(100), ""))

        until(lambda: not one.connection.failure, "it is connected")
        one.connection.call(fill(), 60.0)
        yield one
        one.connection.close(10.0)


def missed(reader: LogReader) -> list[int]:
    """The numbers of the frames after the one that was tracked last, as they are given first."""
    found: list[list[int]] = []
    came = threading.Event()

    def take(messages: list[LogMessage]) -> None:
        found.append([one.seq for one in messages])
        came.set()

    reader.missed(LAST_TRACKED, take)
    assert came.wait(60.0)
    return found[0]


def test_the_newest_frames_are_given(filled: MessageLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """All that came after a position, but no more than a session takes, nor what is older than of use."""
    reader = LogReader(filled, 0.0)
    assert missed(reader) == list(range(TRACKED + 1, FRAMES))
    monkeypatch.setattr(log_reader, "MOST_FRAMES", 5)
    assert missed(reader) == list(range(FRAMES - 5, FRAMES))
    monkeypatch.setattr(log_reader, "MOST_BYTES", 300)
    assert missed(reader) == list(range(FRAMES - 3, FRAMES))
    monkeypatch.undo()
    monkeypatch.setattr(log_reader, "OUTAGE_S", 0.0)
    assert missed(reader) == [FRAMES - 1]
