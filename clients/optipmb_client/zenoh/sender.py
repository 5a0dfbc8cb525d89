"""Publishers: what is sent with a cache for those who lost it or come late, and what is sent at a lower priority."""

from typing import Any

import zenoh
import zenoh.ext
from optipmb_schemas import Message, encode

from optipmb_client.errors import ConnectionFailed

__all__ = ["HEARTBEAT_S", "Sender", "cached_sender", "plain_sender"]

HEARTBEAT_S = 1.0  # how long the loss of a newest message may stay unnoticed, when no other one follows


class Sender:
    """A publisher of encoded messages on one key."""

    def __init__(self, publisher: Any, matching: Any) -> None:
        self._publisher = publisher  # Any: Zenoh leaves parts of these untyped, and one wrongly typed
        self._matching = matching

    @property
    def wanted(self) -> bool:
        """Whether somebody is known to listen. Always True with a cache: that also serves those who come later."""
        matching = self._matching  # `close` may take it away meanwhile
        return matching is None or bool(matching.matching_status.matching)

    def pack(self, message: Message) -> bytes:
        """Return a message as it is sent."""
        return encode(message)

    def put(self, payload: bytes) -> None:
        """Send one message; does not wait for anybody to receive it.

        Raises:
            ConnectionFailed: After `close`.
        """
        publisher = self._publisher
        if publisher is None:
            raise ConnectionFailed("this publisher has been closed")
        try:
            publisher.put(payload)
        except zenoh.ZError as error:
            raise ConnectionFailed("this publisher has been closed") from error

    def close(self) -> None:
        """Withdraw the publisher.

        It is let go of; a message that another thread is sending may still go out. What Zenoh calls `undeclare` waits
        for the heartbeats to end with the lock of the interpreter held; while the thread that sends them waits for that
        lock, the whole process would be blocked for ten seconds.
        """
        self._publisher = self._matching = None


def cached_sender(session: zenoh.Session, key: str, encoding: str, cache: int) -> Sender:
    """Declare a publisher for small messages that must not get lost: it keeps the newest `cache` for recovery."""
    return _with_cache(session, key, encoding, cache, zenoh.Priority.DATA_HIGH, express=True)


def plain_sender(session: zenoh.Session, key: str, encoding: str, cache: int) -> Sender:
    """Declare a publisher for large messages: lower priority than the small ones; with `cache` it keeps the newest."""
    if cache:
        return _with_cache(session, key, encoding, cache, zenoh.Priority.DATA_LOW, express=False)
    publisher = session.declare_publisher(
        key,
        encoding=encoding,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_LOW,
    )
    return Sender(publisher, publisher)


def _with_cache(
    session: zenoh.Session, key: str, encoding: str, cache: int, priority: zenoh.Priority, *, express: bool
) -> Sender:
    publisher = zenoh.ext.declare_advanced_publisher(
        session,
        key,
        encoding=encoding,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=priority,
        express=express,
        cache=zenoh.ext.CacheConfig(cache),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
        publisher_detection=True,
    )
    return Sender(publisher, None)
