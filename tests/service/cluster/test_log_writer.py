"""The queue of the log is bounded in bytes; dropped messages are reported."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import structlog
from nats_process import NatsProcess, NatsTrio, started
from optipmb_service.app.cli import nats_server
from optipmb_service.cluster import message_log, nats_connection
from optipmb_service.cluster.message_log import ALONE_TRIES, OVERHEAD, LogMessage, LogWriter, MessageLog, Retention
from optipmb_service.cluster.nats_connection import NatsRefusedError
from router import until
from routers import free_endpoint

ROOM = 5
PATIENCE_S = 20.0
KEEP = {"detections": Retention(60, 2**25)}


def message(seq: int, size: int) -> LogMessage:
    return LogMessage("detections", "a/b/c", bytes(16), seq, seq, "", (0, 0), bytes(size), "")


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(message_log, "RETRY_S", 0.05)


@pytest.fixture
def log(tmp_path: Path) -> Iterator[MessageLog]:
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
    """One that is too large with its headers is reported with stream, topic and size; the others are written."""
    lost: list[tuple[str, str]] = []
    most = log.connection.client().max_payload
    writer = LogWriter(log, KEEP, lambda *one: lost.append(one))
    for seq, size in enumerate((100, most - 1, most - 1000, 100)):
        writer.put(message(seq, size))
    until(writer.idle, "all are written, or lost")
    writer.close()
    assert (writer.written, writer.dropped, writer.failure) == (3, 1, "")
    ((stream, why),) = lost
    assert (stream, why.split()[0]) == ("a/b/c", "detections:")
    assert int(why.split()[1]) > most
    assert why.endswith(f"{most} at once")


def test_a_failure_holds_until_something_is_written(log: MessageLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """Servers that answer and refuse a message are no servers that take one."""
    put, failures = log.put, []
    writer = LogWriter(log, KEEP, lambda *_: None)
    until(lambda: not writer.failure, "the log is there")

    async def refusing(one: LogMessage) -> bool:
        failures.append(writer.failure)
        if len(failures) < ROOM - 2:
            raise NatsRefusedError({"description": "no room"})
        return await put(one)

    monkeypatch.setattr(log, "put", refusing)
    writer.put(message(0, 100))
    until(writer.idle, "it is written")
    writer.close()
    assert ["no room" in one for one in failures] == [False, True, True]
    assert (writer.written, writer.failure) == (1, "")


def test_a_message_that_may_not_be_published_is_given_up(tmp_path: Path) -> None:
    """One on a forbidden subject is lost after some tries; the next ones are written."""
    address = free_endpoint().removeprefix("tcp/")
    file = tmp_path / "nats.conf"
    file.write_text(f"""
        listen: "{address}"
        jetstream {{ store_dir: "{tmp_path / "store"}" }}
        authorization {{ users: [
            {{ user: one, password: one, permissions: {{ publish: {{ deny: "*.a.b.c" }} }} }}
        ] }}
    """)
    server = nats_server()
    assert server is not None
    process = started([server, "--config", str(file)], address, tmp_path / "nats.log")
    log = MessageLog([f"nats://one:one@{address}"], "optipmb")
    lost: list[tuple[str, str]] = []
    try:
        until(lambda: not log.connection.failure, "it is connected")
        writer = LogWriter(log, KEEP, lambda *one: lost.append(one))
        for seq in range(ROOM):
            writer.put(message(seq, 100) if seq == 0 else message(seq, 100)._replace(stream="a/b/d"))
        until(writer.idle, "all are written, or lost")
        writer.close()
        assert (writer.written, writer.dropped, writer.failure) == (ROOM - 1, 1, "")
        assert [stream for stream, _ in lost] == ["a/b/c"]
    finally:
        log.connection.close(10.0)
        process.kill()
        process.wait(60)


def test_a_message_that_lets_no_other_be_written_is_given_up(log: MessageLog, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that has the server close the connection costs itself alone, and is tried a bounded number of times."""
    put, tries, at_once = log.put, [], 0

    async def closing(one: LogMessage) -> bool:
        nonlocal at_once
        at_once += 1
        try:
            await asyncio.sleep(0)
            if one.seq == ROOM:
                tries.append(at_once)
            if one.seq == ROOM or at_once > 1:
                raise NatsRefusedError({"description": "closed"})
            return await put(one)
        finally:
            at_once -= 1

    writer = LogWriter(log, KEEP, lambda *_: None)
    until(lambda: not writer.failure, "the log is there")
    monkeypatch.setattr(log, "put", closing)
    for seq in range(2 * ROOM):
        writer.put(message(seq, 100))
    until(lambda: writer.written >= 2 * ROOM - 1, "the others are written")
    until(writer.idle, "nothing waits")
    writer.close()
    assert (writer.written, writer.dropped) == (2 * ROOM - 1, 1)
    assert tries.count(1) >= ALONE_TRIES
    assert len(tries) <= 3 * ALONE_TRIES


def test_servers_that_are_away_cost_no_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What fails while the log is not there is no try: all is written when it is back."""
    with NatsProcess(tmp_path) as nats:
        log = MessageLog([nats.url], "optipmb/v1")
        writer = LogWriter(log, KEEP, lambda *_: None)
        asked: list[object] = []
        ready = log.ready

        async def counting(*arguments: Any) -> None:
            asked.append(arguments)
            await ready(*arguments)

        try:
            writer.put(message(0, 100))
            until(writer.idle, "it is written")
            monkeypatch.setattr(log, "ready", counting)
            nats.kill()
            for seq in range(1, ROOM):
                writer.put(message(seq, 100))
            until(lambda: len(asked) > 2 * ALONE_TRIES, "it was tried more often than a message would be")
            nats.start()
            until(writer.idle, "all are written")
            assert (writer.written, writer.dropped, writer.failure) == (ROOM, 0, "")
        finally:
            writer.close()
            log.connection.close(10.0)


def test_two_writers_on_three_servers_write_each_message_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The server tells both that the other is just writing, which is no failure: neither is ever degraded."""
    count = 1000
    with NatsTrio(tmp_path) as servers:
        logs = [MessageLog(servers.urls, "optipmb/v1") for _ in range(2)]
        writers = [LogWriter(log, KEEP, lambda *_: None) for log in logs]
        try:
            for writer in writers:
                writer.put(message(0, 1000))
            until(lambda: all(writer.idle() for writer in writers), "all servers know which one leads")
            # On a busy machine an answer may take longer than a second.
            monkeypatch.setattr(nats_connection, "CALL_S", PATIENCE_S)
            monkeypatch.setattr(message_log, "TRIES", round(PATIENCE_S / message_log.AGAIN_S))
            with structlog.testing.capture_logs() as lines:
                for seq in range(1, count):
                    for writer in writers:
                        writer.put(message(seq, 1000))
                until(lambda: all(writer.idle() for writer in writers), "all are written")
            assert lines == []
            assert [writer.written + writer.repeated for writer in writers] == [count, count]
            assert sum(writer.written for writer in writers) == count
        finally:
            for writer in writers:
                writer.close()
            for log in logs:
                log.connection.close(10.0)


def test_a_log_that_somebody_has_removed_is_made_again(log: MessageLog) -> None:
    """The first message that finds no log waits for it; none is lost."""
    writer = LogWriter(log, KEEP, lambda *_: None)
    writer.put(message(0, 100))
    until(writer.idle, "it is written")
    log.connection.call(log.connection.ask("STREAM.DELETE.OPTIPMB-DETECTIONS_optipmb_2fv1", {}))
    writer.put(message(1, 100))
    until(writer.idle, "it is written")
    writer.close()
    assert (writer.written, writer.dropped, writer.failure) == (2, 0, "")


def test_a_message_that_is_too_large_for_its_log_is_given_up_at_once(log: MessageLog) -> None:
    """A limit that somebody has set for the messages of a log is as one of the servers."""
    lost: list[tuple[str, str]] = []
    writer = LogWriter(log, KEEP, lambda *one: lost.append(one))
    until(lambda: not writer.failure, "the log is there")
    name = "OPTIPMB-DETECTIONS_optipmb_2fv1"
    config = log.connection.call(log.connection.ask(f"STREAM.INFO.{name}", {}))["config"]
    log.connection.call(log.connection.ask(f"STREAM.UPDATE.{name}", {**config, "max_msg_size": 1000}))
    for seq, size in enumerate((100, 2000, 100)):
        writer.put(message(seq, size))
    until(writer.idle, "all are written, or lost")
    writer.close()
    assert (writer.written, writer.dropped, writer.failure) == (2, 1, "")
    assert "size" in lost[0][1]
