"""A Zenoh session with what the service declares on it: what it reads, what it sends, who it is; and their end."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import TYPE_CHECKING, Final, Literal

import optipmb_schemas as schemas
import structlog
import zenoh
import zenoh.ext

from optipmb_service.runtime.ports import Packet, TransportError
from optipmb_service.zenoh.client import Client
from optipmb_service.zenoh.connection import close, line, opened
from optipmb_service.zenoh.handles import (
    Publisher,
    Question,
    Readers,
    cached_publisher,
    publish_problem,
    undeclare,
)
from optipmb_service.zenoh.subscription import Subscription

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from optipmb_service.runtime.ports import Request
    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.handles import Undeclared

CHANNEL: Final = 4096
"""Messages between Zenoh and a draining thread; more than any publisher's history."""

HISTORY_S: Final = 60.0
"""Age of what is fetched from the publishers' small caches when the service starts or a publisher appears."""

TRACKS_CACHE: Final = 50
"""Tracks kept per stream for subscribers that lost some or come late: 5 s at 10 Hz. Most of what a stream holds."""

log = structlog.get_logger("optipmb_service")


class Transport:
    """A Zenoh session with what the service declares on it.

    Args:
        settings: endpoints, prefix, instance.

    Raises:
        TransportError: an endpoint is in use or unusable. As a client it does not raise but wait for a router.
    """

    def __init__(self, settings: Settings) -> None:
        self._keys = schemas.Keys(settings.prefix)
        self._prefix = settings.prefix
        self._instance = settings.instance
        self._max_bytes = settings.limits.max_bytes
        self._is_router = settings.is_router
        self._session = opened(settings)
        self._readers = Readers()
        self._subscriptions: list[Subscription] = []
        self._claims: set[Publisher] = set()
        self._lock = threading.Lock()
        self._alive: Undeclared | None = None

    # Receiving

    def subscribe(self, on_frame: Callable[[Packet], None], on_cloud: Callable[[Packet], None]) -> None:
        """Hand over the detections and point clouds of all streams, each on a thread of its own."""
        self._subscribe("detections", CHANNEL, lambda sample: self._receive(sample, on_frame))
        self._subscribe("points", CHANNEL // 16, lambda sample: self._receive(sample, on_cloud))

    def _subscribe(self, topic: schemas.Topic, channel: int, receive: Callable[[zenoh.Sample], None]) -> None:
        """Subscribe to a topic of all streams, with what the publishers' caches hold: also of clouds, if they do."""
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_age=HISTORY_S)
        key = self._keys.all(topic)
        self._subscriptions.append(Subscription(self._session, key, receive, channel=channel, history=history))

    def serve(self, about_streams: Callable[[Request], None], about_service: Callable[[Request], None]) -> None:
        """Hand over the queries about streams and those about this instance, each on a thread of its own."""
        self._serve(f"{self._prefix}/*/*/*/q/*", about_streams)
        self.serve_service(about_service)

    def serve_service(self, about_service: Callable[[Request], None]) -> None:
        """Hand over the queries about this instance alone, on a thread of its own."""
        self._serve(f"{self._prefix}/service/{self._instance}/q/*", about_service)

    def ask(self, key: str, timeout: float, payload: bytes = b"", encoding: str = "") -> bytes | None:
        """Ask at a key and return the first answer; None when none comes in time (s)."""
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            for reply in self._session.get(key, timeout=timeout, payload=payload, encoding=encoding or None):
                if (sample := reply.ok) is not None:
                    return bytes(sample.payload.to_bytes())
        return None

    def _serve(self, key: str, answer: Callable[[Request], None]) -> None:
        queryable = self._session.declare_queryable(key, zenoh.handlers.FifoChannel(CHANNEL // 16))
        self._readers.add("queries", queryable, queryable.handler, _answering(answer))

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None], detections: str = "") -> Callable[[], None]:
        """Hand over topic, payload and encoding of the newest detections and tracks of a stream to a viewer.

        Each topic has a thread of its own, until the result is called. Detections of a session of several streams are
        those of `detections`, a pattern of streams.

        Raises:
            TransportError: the session is closed.
        """
        taps: list[Undeclared] = []

        def follow(topic: Literal["tracks", "detections"]) -> None:
            def hand_over(samples: Iterable[zenoh.Sample]) -> None:
                with contextlib.suppress(zenoh.ZError):  # how a channel says that it is closed and empty
                    for sample in samples:
                        receive(topic, sample.payload.to_bytes(), str(sample.encoding))

            key = f"{self._prefix}/{(topic == 'detections' and detections) or stream}/{topic}"
            subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(1))
            taps.append(subscriber)
            threading.Thread(target=hand_over, args=(subscriber.handler,), name=f"viewer-{topic}", daemon=True).start()

        def release() -> None:
            for subscriber in taps:
                undeclare(subscriber)

        try:
            follow("tracks")
            follow("detections")
        except zenoh.ZError as error:
            release()
            raise TransportError(line(error)) from error
        return release

    def client(self) -> Client:
        """Return what an edge in this process uses of the session."""
        return Client(self._session, self._prefix, router=self._is_router)

    def watch(self) -> None:
        """Log the nodes and routers that this session is linked to, as they come and go."""
        listener = self._session.info.declare_transport_events_listener(
            zenoh.handlers.FifoChannel(CHANNEL // 16), history=True
        )
        self._readers.add("links", listener, listener.handler, _log_link)

    def _receive(self, sample: zenoh.Sample, receive: Callable[[Packet], None]) -> None:
        key = str(sample.key_expr)
        wall_ns, now_ns = time.time_ns(), time.monotonic_ns()
        size = len(sample.payload)
        payload = sample.payload.to_bytes() if size <= self._max_bytes else None
        receive(Packet(key, payload, size, str(sample.encoding), wall_ns, now_ns))

    # Sending

    def announce(self) -> None:
        """Say that this instance is alive; to be called when it is ready."""
        self._alive = self._session.liveliness().declare_token(self._keys.alive(self._instance))

    def claim(self, stream: str) -> Publisher:
        """Open the publisher of a stream's tracks and say that this instance tracks it.

        Raises:
            TransportError: the session is closed.
        """
        publisher = cached_publisher(self._session, self._keys.tracks(stream), schemas.Tracks, TRACKS_CACHE)
        try:
            token = self._session.liveliness().declare_token(self._keys.owner(stream, self._instance))
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error
        claim = Publisher(publisher, token, self._forget)
        with self._lock:
            self._claims.add(claim)
        return claim

    def publish_problem(self, problem: schemas.Problem) -> None:
        """Send a problem on its stream's key; one without a stream has no key and is not sent."""
        publish_problem(self._session, self._keys, problem)

    def watch_owners(self, told: Callable[[str, str, bool], None]) -> None:
        """Tell which instance tracks which stream, or does so no longer (False), from now on."""
        tokens = self._session.liveliness().declare_subscriber(
            self._keys.all_owners(), zenoh.handlers.FifoChannel(CHANNEL), history=True
        )

        def receive(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            told(self._keys.stream_of(key), self._keys.instance_of(key), sample.kind == zenoh.SampleKind.PUT)

        self._readers.add("owners", tokens, tokens.handler, receive)

    # The end

    def leave(self) -> None:
        """Say that this instance is alive no longer."""
        if self._alive is not None:
            undeclare(self._alive)
            self._alive = None

    def stop(self, timeout: float) -> None:
        """Receive nothing any more; what was received before is handed over within `timeout` seconds."""
        self.leave()
        for subscription in self._subscriptions:
            subscription.close(timeout)
        self._subscriptions.clear()
        self._readers.stop(timeout)

    def close(self) -> None:
        """Withdraw everything and close the session."""
        self.stop(timeout=0.2)
        with self._lock:
            claims = tuple(self._claims)
        for claim in claims:
            claim.release()
        close(self._session)

    def _forget(self, claim: Publisher) -> None:
        with self._lock:
            self._claims.discard(claim)


def _answering(answer: Callable[[Request], None]) -> Callable[[zenoh.Query], None]:
    return lambda query: answer(Question(query))


def _log_link(event: zenoh.TransportEvent) -> None:
    came = event.kind == zenoh.SampleKind.PUT
    log.info(
        "peer_connected" if came else "peer_lost", peer=str(event.transport.zid), kind=str(event.transport.whatami)
    )
