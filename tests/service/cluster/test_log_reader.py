"""Reading the log for a session is bounded; it gets the newest frames."""

import asyncio
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import AsyncMock, Mock

import pytest
from nats_process import NatsProcess
from optipmb_schemas import Keys
from optipmb_service.cluster import message_log
from optipmb_service.cluster.message_log import LogMessage, LogReader, MessageLog, Retention
from optipmb_service.cluster.store import LogQuery, Position
from optipmb_service.session.checkpoint import forgotten
from optipmb_service.session.policy import Policy
from optipmb_service.session.session import Session
from optipmb_service.streams.profiles import Fusion
from optipmb_service.streams.recovery import Log
from optipmb_service.zenoh.topics import Packet
from router import until

import optipmb

STREAM = "a/b/c"
EPOCH = bytes(16)
FRAMES = 20
TRACKED = 4
LAST_TRACKED = LogQuery((STREAM,), "", lambda _: False, {STREAM: Position(frozenset(), EPOCH, TRACKED, tracked=True)})


@pytest.fixture
def filled(tmp_path: Path) -> Iterator[MessageLog]:
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


def asked(reader: LogReader) -> Callable[[], list[int]]:
    """Ask for the frames after the one that was tracked last; waits for the numbers of the first result."""
    found: list[list[int]] = []
    came = threading.Event()

    def take(messages: list[LogMessage]) -> None:
        found.append([one.seq for one in messages])
        came.set()

    def wait() -> list[int]:
        assert came.wait(60.0)
        return found[0]

    reader.missed(LAST_TRACKED, take)
    return wait


def missed(reader: LogReader) -> list[int]:
    """The numbers of the frames after the one that was tracked last, as they are given first."""
    return asked(reader)()


def test_the_newest_frames_are_given(filled: MessageLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """All frames after a position, as many as a session takes, and none too old for it."""
    reader = LogReader(filled, 0.0)
    assert missed(reader) == list(range(TRACKED + 1, FRAMES))
    monkeypatch.setattr(message_log, "MOST_FRAMES", 5)
    assert missed(reader) == list(range(FRAMES - 5, FRAMES))
    monkeypatch.setattr(message_log, "MOST_BYTES", 300)
    assert missed(reader) == list(range(FRAMES - 3, FRAMES))
    monkeypatch.undo()
    monkeypatch.setattr(message_log, "OUTAGE_S", 0.0)
    assert missed(reader) == [FRAMES - 1]


def test_the_time_for_a_stream_begins_with_its_turn(filled: MessageLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream that waits until another one has used up its time is read all the same."""
    monkeypatch.setattr(message_log, "READ_AT_ONCE", 1)
    monkeypatch.setattr(message_log, "READ_S", 2.0)
    since, stuck = filled.since, threading.Event()

    async def once_stuck(*what: Any) -> int | None:
        if not stuck.is_set():
            stuck.set()
            await asyncio.Event().wait()
        return await since(*what)

    monkeypatch.setattr(filled, "since", once_stuck)
    reader = LogReader(filled, 0.0)
    first, second = asked(reader), asked(reader)
    assert first() == []
    assert second() == list(range(TRACKED + 1, FRAMES))


def test_a_session_begins_whatever_the_log_says(filled: MessageLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """An unforeseen error, in the reading or before it, is as if nothing had been missed."""
    monkeypatch.setattr(filled, "since", AsyncMock(side_effect=ValueError("no JSON")))
    reader = LogReader(filled, 0.0)
    assert missed(reader) == []

    found: list[Sequence[object]] = []
    monkeypatch.setattr(reader, "missed", Mock(side_effect=ValueError("a mistake")))
    Log(reader, Keys(), Fusion(())).fetch(STREAM, None, found.append, found.append)
    assert found == [[]]


def test_what_was_closed_does_not_come_back(filled: MessageLog) -> None:
    """A session of several sensors that was closed by a query begins with new frames, not with those in the log.

    Others begin with the frames of their node or site.
    """
    state = Session("a/b/fused", optipmb.load_profile("nuscenes"), Policy(), fused=True)
    closed = forgotten(state.snapshot())
    found: list[list[tuple[Packet, bool]]] = []
    came = threading.Event()

    def take(packets: list[tuple[Packet, bool]]) -> None:
        found.append(packets)
        came.set()

    frames = Log(LogReader(filled, 600.0), Keys(), Fusion(("a/*/*",)))
    of_site = Log(LogReader(filled, 600.0), Keys(), Fusion((), {"a/fused/x": ["a/*/c"], "b/fused/x": ["b/*/*"]}))
    asked = ((frames, "a/b/fused", None), (frames, "a/b/fused", closed), (of_site, "a/fused/x", None))
    for reader, session, checkpoint in (*asked, (of_site, "b/fused/x", None)):
        came.clear()
        reader.fetch(session, checkpoint, take, lambda _: None)
        assert came.wait(60.0)
    assert [len(one) for one in found] == [FRAMES, 0, FRAMES, 0]


def test_a_log_that_is_not_there_is_asked_for_once_in_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand sessions that begin without a log cost the servers one question, and find the log when it is made."""
    monkeypatch.setattr("optipmb_service.cluster.message_log.MISSING_S", 3600.0)
    with NatsProcess(tmp_path) as nats:
        one = MessageLog([nats.url], "optipmb/v1")
        asking = AsyncMock(wraps=one.connection.read)
        monkeypatch.setattr(one.connection, "read", asking)

        async def look() -> list[object]:
            return [await one.since("detections", f"a/b/{number}", lambda _: False) for number in range(1000)]

        async def put() -> None:
            await one.ready("detections", Retention(600, 2**24))
            await one.put(LogMessage("detections", STREAM, EPOCH, 0, 0, "", (0, 0), b"1", ""))

        until(lambda: not one.connection.failure, "it is connected")
        assert one.connection.call(look(), 60.0) == [None] * 1000
        assert asking.await_count == 1
        one.connection.call(put(), 60.0)
        one._missing_until.clear()  # the time has passed
        assert one.connection.call(one.since("detections", STREAM, lambda _: False), 60.0) is not None
        one.connection.close(10.0)
