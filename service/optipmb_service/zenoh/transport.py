"""A Zenoh session with what the service declares on it: what it reads, what it sends, who it is; and their end."""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas
import zenoh
import zenoh.ext

from optipmb_service.runtime.ports import Packet, TransportError
from optipmb_service.zenoh import key_numbers
from optipmb_service.zenoh.announcements import Announcements
from optipmb_service.zenoh.client import Client
from optipmb_service.zenoh.connection import close, line, log_link, opened
from optipmb_service.zenoh.handles import (
    Channel,
    Publisher,
    Readers,
    Replies,
    cached_publisher,
    publish_problem,
    undeclare,
)
from optipmb_service.zenoh.inputs import ReturnedPublishers, Topic
from optipmb_service.zenoh.queries import OpenQueries
from optipmb_service.zenoh.subscription import ask_cache
from optipmb_service.zenoh.taps import Taps

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from optipmb_service.runtime.intake import Kind
    from optipmb_service.runtime.ports import Request
    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.handles import Undeclared

CHANNEL: Final = 4096
"""Messages between Zenoh and a draining thread; more than any publisher's history."""

RECENT_S: Final = 2.0
"""How long other instances may take to answer what they have received of streams that have come here."""

TRACKS_CACHE: Final = 100
"""Tracks kept per stream for subscribers that lost some or come late: 5 s at 20 Hz. Most of what a stream holds.

It is longer than a dead link of the client library takes to be noticed and replaced, 4 s.
"""

CACHES_S: Final = 1.0
"""How long the caches may take to answer."""


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
        self._topics: dict[str, Topic] = {}
        self._discover: Callable[[zenoh.Sample], None] = lambda _: None
        self._all = False
        self._run = secrets.token_hex(8)
        """Tells this process from all others, also from those of its name."""
        self._announcements = Announcements(self._session, self._keys, self._instance, self._run)
        self._returned = ReturnedPublishers(self._session, lambda *_: 0)
        self._publishers: set[Publisher] = set()
        self._lock = threading.Lock()
        self._alive: Undeclared | None = None
        self._taps = Taps(self._session, self._prefix)

    # Receiving

    def receive(
        self,
        on_frame: Callable[[Packet], None],
        on_cloud: Callable[[Packet], None],
        noticed: Callable[[str, bool], bool],
        passed_by: Callable[[str, int], None],
        answered: Callable[[str], None],
    ) -> None:
        """Hand over the detections and point clouds that are subscribed to, on threads of the network.

        Args:
            on_frame: takes detections.
            on_cloud: takes clouds.
            noticed: called for detections that come by a subscription to all, by key and whether they can be recovered;
                where that is `discovery`, those alone are handed over for which it returns True.
            passed_by: called with the keys and sizes of the others.
            answered: called with a key when all detections have been handed over that a publisher's cache held.
        """

        def discover(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if noticed(key, sample.source_info is not None):
                self._receive(sample, key, on_frame)
            else:
                passed_by(key, len(sample.payload))

        def detected(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if self._all:
                noticed(key, sample.source_info is not None)
            self._receive(sample, key, on_frame)

        self._discover = discover
        self._topics = {
            "detections": Topic("detections", self._session, detected, answered),
            "points": Topic("points", self._session, lambda one: self._receive(one, str(one.key_expr), on_cloud)),
        }
        self._returned = ReturnedPublishers(self._session, self._topics["detections"].due)
        # A name with a part too few or too many matches no other subscription: it is received to be refused.
        for names in ("*/*", "*/*/*/*"):
            self._topics["detections"].subscribe(names, f"{self._prefix}/{names}/detections", detected, cached=False)

    def subscribe(self, kind: Kind, stream: str, *, cached: bool) -> None:
        """Receive the detections or clouds of a stream, or of all of them where it is empty; `discovery` is of all.

        Args:
            kind: what of it.
            stream: its name.
            cached: whether what was lost is recovered from the publisher's cache.

        Raises:
            TransportError: the session is closed.
        """
        if kind == "discovery":
            self._topics["detections"].subscribe(kind, self._keys.all("detections"), self._discover)
        else:
            self._all = self._all or not stream
            self._topics[kind].subscribe(_name(stream, cached=cached), self._key(kind, stream), cached=cached)

    def unsubscribe(self, inputs: Iterable[tuple[Kind, str, bool]]) -> None:
        """Withdraw subscriptions."""
        names: dict[str, list[str]] = {topic: [] for topic in self._topics}
        for kind, stream, cached in inputs:
            if kind == "discovery":
                names["detections"].append(kind)
            else:
                self._all = self._all and bool(stream)
                names[kind].append(_name(stream, cached=cached))
        for topic, left in names.items():
            self._topics[topic].leave(left)

    def _key(self, topic: schemas.Topic, stream: str) -> str:
        return self._keys.matching(stream, topic) if stream else self._keys.all(topic)

    def pass_through(self, then: Callable[[], None]) -> None:
        """Call `then` when all that has come until now is handed over."""
        detections, points = self._topics.values()
        detections.pass_through(lambda: points.pass_through(then))

    def watch_streams(
        self, published: Callable[[str, str, bool], None], discovered: Callable[[str, bool], None]
    ) -> None:
        """Tell of publishers of detections with a cache, by key and token, and of others' announcements, by token."""

        def announced(key: str, present: bool) -> None:  # noqa: FBT001 - as a token is told
            if not self._keys.discovered_by(key, self._run):
                discovered(key, present)

        def returned(key: str, present: bool) -> None:  # noqa: FBT001 - as a token is told
            published(key, key, present)
            if present:
                self._returned.came(key)

        self._watch("publishers", self._keys.all_publishers(), returned)
        self._watch("discovered", self._keys.all_discovered(), announced)

    def discover(self, streams: set[str]) -> None:
        """Announce these streams, and no others."""
        self._announcements.announce(streams)

    def ask_recent(self, sessions: Sequence[str]) -> list[tuple[Packet, bool]]:
        """Return what other instances have received lately of sessions, each packet with whether it is a frame.

        The question has the lowest priority: it overtakes no message on the way to who is asked.
        """
        found, replies = [], Replies(RECENT_S)
        try:
            self._session.get(
                self._keys.recent(),
                replies.handler,
                payload="\n".join(sessions),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                allowed_destination=zenoh.Locality.REMOTE,
                priority=zenoh.Priority.BACKGROUND,
                timeout=RECENT_S,
            )
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error
        for reply in replies:
            if (sample := reply.ok) is not None and (about := sample.attachment) is not None:
                key, payload = about.to_string(), sample.payload.to_bytes()
                now = time.time_ns(), time.monotonic_ns()
                packet = Packet(key, payload, len(payload), str(sample.encoding), *now)
                found.append((packet, key.endswith("/detections")))
        return found

    def ask_cache(self, stream: str, then: Callable[[list[tuple[Packet, bool]], bool], None]) -> None:
        """Call `then`, on a thread of the network, with what the caches of a stream hold of its detections, all frames.

        It is called, too, with whether all caches have answered in time.

        Raises:
            TransportError: the session is closed.
        """
        found: list[tuple[Packet, bool]] = []

        def reply(sample: zenoh.Sample) -> None:
            self._receive(sample, str(sample.key_expr), lambda packet: found.append((packet, True)))

        try:
            ask_cache(self._session, f"{self._keys.detections(stream)}/@adv/pub/**", reply, partial(then, found))
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    def find_duplicate_name(self, found: Callable[[], None]) -> None:
        """Call `found`, on a thread of the network, for each other process with the name of this one."""

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found()

        with contextlib.suppress(zenoh.ZError):  # the session is closed
            self._session.get(
                self._keys.metrics(self._instance),
                zenoh.handlers.Callback(take, indirect=False),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                congestion_control=zenoh.CongestionControl.DROP,
                allowed_destination=zenoh.Locality.REMOTE,
                priority=zenoh.Priority.BACKGROUND,
                timeout=RECENT_S,
            )

    def look_for_returned(self, report: Callable[[str, int, int], None]) -> None:
        """Call `report` for each publisher that came back with numbers below those that it has sent.

        It is called on a thread of the network, with the key of its token, the number expected next and its newest one.
        """
        self._returned.look(report)

    def serve(self, about_streams: Callable[[Request], None], about_service: Callable[[Request], None]) -> None:
        """Hand over the queries about streams and those about this instance, each on a thread of its own."""
        self._serve(f"{self._prefix}/*/*/*/q/*", about_streams)
        self.serve_service(about_service)

    def serve_service(self, about_service: Callable[[Request], None], names: Sequence[str] = ("*",)) -> None:
        """Hand over the queries about this instance alone, those of each name on a thread of its own.

        Who asks all instances waits for each that declares the name, so one that takes no such query must not.
        """
        for name in names:
            self._serve(f"{self._prefix}/service/{self._instance}/q/{name}", about_service)

    def ask(self, key: str, timeout: float, payload: bytes = b"", encoding: str = "") -> bytes | None:
        """Ask at a key and return the first answer; None when none comes in time (s)."""
        replies = Replies(timeout)
        try:
            self._session.get(key, replies.handler, timeout=timeout, payload=payload, encoding=encoding or None)
        except zenoh.ZError:  # the session is closed
            return None
        samples = (sample for reply in replies if (sample := reply.ok) is not None)
        return next((bytes(sample.payload.to_bytes()) for sample in samples), None)

    def _serve(self, key: str, answer: Callable[[Request], None]) -> None:
        queries = OpenQueries(self._instance)
        key_numbers.take(self._session, key_numbers.PLAIN)
        queryable = self._session.declare_queryable(key, queries.handler)
        self._readers.add("queries", queryable, queries, answer)

    def tap(self, stream: str, receive: Callable[[str, bytes, str], None], detections: str = "") -> Callable[[], None]:
        """Hand over topic, payload and encoding of the newest detections and tracks of a stream to a viewer.

        Viewers of a stream share its subscriptions, until the last of them has called the result. Detections of a
        session of several streams are those of `detections`, a pattern of streams.

        Raises:
            TransportError: the session is closed, or too many other streams were looked at.
        """
        return self._taps.join((stream, detections or stream), receive)

    def recent_tracks(self, stream: str) -> list[tuple[bytes, str]]:
        """Return what those who track a stream keep of its tracks for subscribers, each message with its encoding.

        Raises:
            TransportError: the session is closed.
        """
        return [(one.payload, one.encoding) for one in self.client().recent(self._keys.tracks(stream), CACHES_S)]

    def client(self) -> Client:
        """Return what an edge in this process uses of the session."""
        return Client(self._session, self._prefix, router=self._is_router)

    def watch(self) -> None:
        """Log the nodes and routers that this session is linked to, as they come and go."""
        channel: Channel[zenoh.TransportEvent] = Channel(CHANNEL // 16)
        listener = self._session.info.declare_transport_events_listener(channel.handler, history=True)
        self._readers.add("links", listener, channel, log_link)

    def _receive(self, sample: zenoh.Sample, key: str, receive: Callable[[Packet], None]) -> None:
        wall_ns, now_ns = time.time_ns(), time.monotonic_ns()
        payload = sample.payload
        size = len(payload)
        data = payload.to_bytes() if size <= self._max_bytes else None
        receive(Packet(key, data, size, str(sample.encoding), wall_ns, now_ns))

    # Sending

    def announce(self) -> None:
        """Say that this instance is alive; to be called when it is ready."""
        self._alive = self._session.liveliness().declare_token(self._keys.alive(self._instance))

    def open_publisher(self, stream: str) -> Publisher:
        """Open the publisher of a stream's tracks, say that this instance tracks it, and declare its inputs' keys.

        Raises:
            TransportError: the session is closed, or has declared all keys that it can.
        """
        # Who subscribes asks the caches, and hears by heartbeats of what it missed: nobody needs a token for that, and
        # each costs the router more the more there are.
        taken = key_numbers.take(self._session, key_numbers.CACHED)
        publisher = cached_publisher(
            self._session, self._keys.tracks(stream), schemas.Tracks, TRACKS_CACHE, detected=False
        )
        try:
            token = self._session.liveliness().declare_token(self._keys.owner(stream, self._instance))
            keys = (self._keys.detections(stream), self._keys.points(stream)) if self._all else ()
            inputs = [key_numbers.DeclaredKey(self._session, key) for key in keys]
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error
        whole = Publisher(publisher, (token, taken, *inputs), self._forget)
        with self._lock:
            self._publishers.add(whole)
        return whole

    def publish_problem(self, problem: schemas.Problem) -> None:
        """Send a problem on its stream's key; one without a stream has no key and is not sent."""
        publish_problem(self._session, self._keys, problem)

    def watch_owners(self, on_owner: Callable[[str, str, bool], None] | None) -> None:
        """Tell which instance tracks which stream, or does so no longer (False), from now on; None: nobody any more.

        Raises:
            TransportError: the session is closed.
        """
        self._readers.end("owners")
        if on_owner is not None:
            self._watch(
                "owners",
                self._keys.all_owners(),
                lambda key, present: on_owner(self._keys.stream_of(key), self._keys.instance_of(key), present),
            )

    def _watch(self, name: str, pattern: str, on_token: Callable[[str, bool], None]) -> None:
        """Tell of the tokens of a pattern, those that are there and those that come and go."""
        channel: Channel[zenoh.Sample] = Channel(CHANNEL)
        try:
            tokens = self._session.liveliness().declare_subscriber(pattern, channel.handler, history=True)
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error
        self._readers.add(
            name, tokens, channel, lambda one: on_token(str(one.key_expr), one.kind == zenoh.SampleKind.PUT)
        )

    # The end

    def leave(self) -> None:
        """Say that this instance is alive no longer."""
        if self._alive is not None:
            undeclare(self._alive)
            self._alive = None

    def stop(self, timeout: float) -> None:
        """Receive nothing any more; what was received before is handed over within `timeout` seconds."""
        self.leave()
        for topic in self._topics.values():
            topic.close(timeout)
        self._readers.stop(timeout)

    def close(self) -> None:
        """Withdraw everything and close the session."""
        self.stop(timeout=0.2)
        with self._lock:
            publishers = tuple(self._publishers)
        for publisher in publishers:
            publisher.release()
        close(self._session)

    def _forget(self, publisher: Publisher) -> None:
        with self._lock:
            self._publishers.discard(publisher)


def _name(stream: str, *, cached: bool) -> str:
    """Return the name of a subscription; for a moment there may be one with recovery and one without."""
    return stream if cached else f"{stream} plain"
