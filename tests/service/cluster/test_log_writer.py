"""What waits for the log is bounded in bytes; what is dropped is said."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from nats_process import NatsProcess
from optipmb_service.cluster.log_writer import OVERHEAD, LogWriter
from optipmb_service.cluster.message_log import LogMessage, MessageLog, Retention
from optipmb_service.cluster.nats_connection import RefusedError
from router import until
from routers import free_endpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

ROOM = 5
KEEP = {"detections": Retention(60, 2**25)}


def message(seq: int, size: int) -> LogMessage:
    """Detections of so many bytes."""
    return LogMessage("detections", "a/b/c", bytes(16), seq, seq, "", (0, 0), bytes(size), "")


@pytest.fixture
def log(tmp_path: Path) -> Iterator[MessageLog]:
    """A log with a server."""
    with NatsProcess(tmp_path) as nats:
        one = MessageLog([nats.url], "optipmb/v1")
        until(lambda: not one.connection.failure, "it is connected")
        yield one
        one.connection.close(10.0)


def test_without_servers_the_oldest_messages_go() -> None:
    """Never more bytes wait than may; each message that is lost is reported with its stream and the reason."""
    address = free_endpoint().removeprefix("tcp/")
    log = MessageLog([f"nats://{address}"], "optipmb/v1")
    lost: list[tuple[str, str]] = []
    size = OVERHEAD + 100
    writer = LogWriter(log, KEEP, lambda *one: lost.append(one), held_bytes=ROOM * size)
    try:
        for seq in range(2 * ROOM):
            writer.put(LogMessage("detections", f"a/b/{seq}", bytes(16), seq, seq, "", (0, 0), bytes(100), ""))
            assert writer.held_bytes <= ROOM * size
        assert [stream for stream, _ in lost] == [f"a/b/{seq}" for seq in range(ROOM)]
        assert all("bytes" in why for _, why in lost)
        assert (writer.dropped, writer.written, writer.idle()) == (ROOM, 0, False)
        assert writer.failure
    finally:
        writer.close()
        log.connection.close(10.0)


def test_a_message_that_the_servers_do_not_take_keeps_none_waiting(log: MessageLog) -> None:
    """One that is too large with its headers is reported; those beside it are written."""
    lost: list[tuple[str, str]] = []
    most = log.connection.client().max_payload
    writer = LogWriter(log, KEEP, lambda *one: lost.append(one))
    for seq, size in enumerate((100, most - 1, most - 1000, 100)):
        writer.put(message(seq, size))
    until(writer.idle, "all are written, or lost")
    writer.close()
    assert (writer.written, writer.dropped, writer.failure) == (3, 1, "")
    assert str(most) in lost[0][1]


def test_a_failure_holds_until_something_is_written(log: MessageLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """Servers that answer and refuse a message are no servers that take one."""
    put, failures = log.put, []
    writer = LogWriter(log, KEEP, lambda *_: None)
    until(lambda: not writer.failure, "the log is there")

    async def refusing(one: LogMessage) -> bool:
        failures.append(writer.failure)
        if len(failures) < ROOM - 2:
            raise RefusedError({"description": "no room"})
        return await put(one)

    monkeypatch.setattr(log, "put", refusing)
    writer.put(message(0, 100))
    until(writer.idle, "it is written")
    writer.close()
    assert ["no room" in one for one in failures] == [False, True, True]
    assert (writer.written, writer.failure) == (1, "")
