"""What waits for the log is bounded in bytes; what is dropped is said."""

from __future__ import annotations

from optipmb_service.cluster.log_writer import OVERHEAD, LogWriter
from optipmb_service.cluster.message_log import LogMessage, MessageLog, Retention
from routers import free_endpoint

ROOM = 5


def test_without_servers_the_oldest_messages_go() -> None:
    """Never more bytes wait than may; each message that is lost is reported with its stream and the reason."""
    address = free_endpoint().removeprefix("tcp/")
    log = MessageLog([f"nats://{address}"], "optipmb/v1")
    lost: list[tuple[str, str]] = []
    size = OVERHEAD + 100
    writer = LogWriter(log, {"detections": Retention(60, 2**24)}, lambda *one: lost.append(one), held_bytes=ROOM * size)
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
