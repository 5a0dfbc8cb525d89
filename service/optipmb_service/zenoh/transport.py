"""A Zenoh session with the declarations of a service: inputs, outputs, tokens, queries."""

from __future__ import annotations

import secrets
import time
from functools import partial
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_client.trace_context import attached

from optipmb_service.zenoh.client import Client
from optipmb_service.zenoh.topics import Packet, ReturnedPublishers, Topic

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from collections.abc import Set as AbstractSet

    from optipmb_client.zenoh.handles import Declaration, Dispatcher, Query, Sender
    from optipmb_client.zenoh.session import Sample, ZenohSession

    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.topics import Kind

MOST_OPEN: Final = 256
"""Queries of one key expression that may be open; those beyond are refused."""

RECENT_S: Final = 2.0
"""How long other instances may take to answer with their messages of streams that have moved here."""

TRACKS_CACHE: Final = 100
"""Tracks kept per stream for subscribers that lost some or come late: 5 s at 20 Hz. Most of what a stream holds.

It is longer than a dead link of the client library takes to be noticed and replaced, 4 s.
"""

ANNOUNCED: Final = 32
"""Streams of one token. A stream that comes or goes costs those who watch as many names as its token has."""

CACHES_S: Final = 1.0
"""How long the caches may take to answer."""


log = structlog.get_logger("optipmb_service")


class StreamPublisher:
    """The publishers of a stream's tracks and events, and what else is declared while it is there."""

    def __init__(
        self, sender: Sender, events: Sender | None, now: Sender | None, others: Sequence[Declaration]
    ) -> None:
        self._declared = (*others, *(one for one in (events, now, sender) if one is not None))
        self.publish = sender.put
        self.publish_events = (events or sender).put
        self.publish_now = (now or sender).put

    def release(self) -> None:
        for one in self._declared:
            one.close()


class Announcements:
    """The streams that a discoverer announces, by tokens of many streams each: all are full, but for one.

    What a router takes to declare a token grows with how many tokens there are, for each that watches them: with a
    token for each stream it was most of what a new stream cost, and with 10,000 streams beyond what one router can do.
    """

    def __init__(self, session: ZenohSession, keys: schemas.Keys, instance: str, run: str) -> None:
        self._session, self._keys, self._instance, self._run = session, keys, instance, run
        self._groups: dict[str, tuple[str, ...]] = {}
        """The group of each stream that is announced."""
        self._tokens: dict[tuple[str, ...], Declaration] = {}

    def announce(self, streams: AbstractSet[str]) -> None:
        """Announce these streams, and no others; streams that stay are announced all the time."""
        new = sorted(streams - self._groups.keys())
        gone = self._groups.keys() - streams
        if not new and not gone:
            return
        left = {self._groups[stream] for stream in gone} | {group for group in self._tokens if len(group) < ANNOUNCED}
        pool = [stream for group in sorted(left) for stream in group if stream not in gone] + new
        groups = [tuple(pool[first : first + ANNOUNCED]) for first in range(0, len(pool), ANNOUNCED)]
        for group in groups:
            if group not in self._tokens:
                self._tokens[group] = self._session.token(self._keys.discovered(group, self._instance, self._run))
            self._groups.update(dict.fromkeys(group, group))
        for group in left.difference(groups):
            self._tokens.pop(group).close()
        for stream in gone:
            del self._groups[stream]


class Transport:
    """A Zenoh session with what the service declares on it.

    Its methods raise `TransportError` when the session is closed, or has declared all keys that it can.

    Raises:
        TransportError: an endpoint is in use or unusable. As a client it does not raise but wait for a router.
    """

    def __init__(self, settings: Settings) -> None:
        self._keys = schemas.Keys(settings.prefix)
        self._prefix = settings.prefix
        self._instance = settings.instance
        self._max_bytes = settings.limits.max_bytes
        self._traces = settings.traces
        self._client = Client(settings)
        self._topics: dict[str, Topic] = {}
        self._discover: Callable[[Sample], None] = lambda _: None
        self._all = False
        self._run = secrets.token_hex(8)
        """Tells this process from all others, also from others of its name."""
        self.discover = Announcements(self._client, self._keys, self._instance, self._run).announce
        """Announces streams, and no others."""
        self._returned = ReturnedPublishers(self._client, lambda *_: 0)
        self._alive: Declaration | None = None
        self._owners: Dispatcher | None = None

    # Receiving

    def receive(
        self,
        take: Callable[[Packet], None],
        noticed: Callable[[str, bool], bool],
        passed_by: Callable[[str, int], None],
        answered: Callable[[str], None],
    ) -> None:
        """Hand over the detections and point clouds that are subscribed to, on threads of the network.

        Args:
            take: takes detections and clouds.
            noticed: called for detections that come by a subscription to all, by key and whether they can be recovered;
                where that is `discovery`, those alone are handed over for which it returns True.
            passed_by: called with the keys and sizes of the others.
            answered: called with a key when all detections have been handed over that a publisher's cache held.
        """

        def discover(sample: Sample) -> None:
            key = str(sample.key_expr)
            if noticed(key, sample.source_info is not None):
                self._receive(sample, key, take)
            else:
                passed_by(key, len(sample.payload))

        def detected(sample: Sample) -> None:
            key = str(sample.key_expr)
            if self._all:
                noticed(key, sample.source_info is not None)
            self._receive(sample, key, take)

        self._discover = discover
        self._topics = {
            "detections": Topic("detections", self._client, detected, answered),
            "points": Topic("points", self._client, lambda one: self._receive(one, str(one.key_expr), take)),
        }
        self._returned = ReturnedPublishers(self._client, self._topics["detections"].due)
        # A name with a part too few or too many matches no other subscription: it is received to be refused.
        for names in ("*/*", "*/*/*/*"):
            self._topics["detections"].subscribe(names, f"{self._prefix}/{names}/detections", detected, cached=False)

    def subscribe(self, kind: Kind, stream: str, *, cached: bool) -> None:
        """Receive the detections or clouds of a stream, or of all of them where it is empty; `discovery` is of all.

        With `cached`, lost messages are recovered from the publisher's cache.
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

        def announced(key: str, present: bool) -> None:  # noqa: FBT001 - the signature of a watcher
            if not self._keys.discovered_by(key, self._run):
                discovered(key, present)

        def returned(key: str, present: bool) -> None:  # noqa: FBT001 - the signature of a watcher
            published(key, key, present)
            if present:
                self._returned.came(key)

        self._client.watch(self._keys.all_publishers(), returned)
        self._client.watch(self._keys.all_discovered(), announced)

    def ask_recent(self, sessions: Sequence[str]) -> list[Packet]:
        """Return what other instances have received lately of sessions, as packets.

        The question has the lowest priority: it overtakes no message on the way to who is asked.
        """
        found = []
        payload = "\n".join(sessions).encode()
        for answer in self._client.query(self._keys.recent(), payload, timeout=RECENT_S, background=True):
            if answer.ok and answer.about:
                now = time.time_ns(), time.monotonic_ns()
                key, _, parent = answer.about.partition("\n")
                found.append(Packet(key, answer.payload, len(answer.payload), answer.encoding, *now, parent))
        return found

    def ask_cache(self, stream: str, then: Callable[[list[Packet], bool], None]) -> None:
        """Call `then`, on a thread of its own, with what the caches of a stream hold of its detections, all frames.

        It is called, too, with whether all caches have answered in time.
        """
        found: list[Packet] = []

        def reply(sample: Sample) -> None:
            self._receive(sample, str(sample.key_expr), found.append)

        self._client.ask(f"{self._keys.detections(stream)}/@adv/pub/**", reply, partial(then, found))

    def find_duplicate_name(self, found: Callable[[], None]) -> None:
        """Call `found`, on a thread of its own, for each other process with the name of this one."""
        self._client.ask(self._keys.metrics(self._instance), lambda _: found(), timeout=RECENT_S, background=True)

    def look_for_returned(self, report: Callable[[str, int, int], None]) -> None:
        """Call `report` for each publisher that came back with numbers below its last ones.

        It is called on a thread of the network, with the key of its token, the number expected next and its newest one.
        """
        self._returned.look(report)

    def serve(self, about_streams: Callable[[Query], None], about_service: Callable[[Query], None]) -> None:
        """Hand over the queries about streams and those about this instance, each on a thread of its own."""
        self._serve(f"{self._prefix}/*/*/*/q/*", about_streams)
        self.serve_service(about_service)

    def serve_service(self, about_service: Callable[[Query], None], names: Sequence[str] = ("*",)) -> None:
        """Hand over the queries about this instance alone, each name on a thread of its own.

        Who asks all instances waits for each that declares the name, so one that takes no such query must not.
        """
        for name in names:
            self._serve(f"{self._prefix}/service/{self._instance}/q/{name}", about_service)

    def ask(self, key: str, timeout: float, payload: bytes = b"", encoding: str = "") -> bytes | None:
        """Ask at a key and return the first answer; None when none comes in time (s)."""
        try:
            answers = self._client.query(key, payload, encoding, timeout=timeout)
        except TransportError:  # the session is closed
            return None
        return next((answer.payload for answer in answers if answer.ok), None)

    def _serve(self, key: str, answer: Callable[[Query], None]) -> None:
        expected, received = f"at most {MOST_OPEN} queries open at once", "another one"
        refusal = schemas.Problem(
            stream="",
            instance=self._instance,
            code="refused",
            path="key",
            expected=expected,
            received=received,
            message=f"Query: key: expected {expected}, received {received}.",
        )
        self._client.serve(key, answer, most=MOST_OPEN, refusal=refusal)

    def recent_tracks(self, stream: str) -> list[tuple[bytes, str]]:
        """Return what those who track a stream keep of its tracks for subscribers, each message with its encoding."""
        return [(one.payload, one.encoding) for one in self._client.cached(self._keys.tracks(stream), timeout=CACHES_S)]

    def client(self) -> Client:
        """Return what an edge in this process uses of the session."""
        return self._client

    def watch(self) -> None:
        """Log the nodes and routers that this session is linked to, as they come and go."""
        self._client.watch_links(_log_link)

    def _receive(self, sample: Sample, key: str, receive: Callable[[Packet], None]) -> None:
        wall_ns, now_ns = time.time_ns(), time.monotonic_ns()
        payload = sample.payload
        size = len(payload)
        data = payload.to_bytes() if size <= self._max_bytes else None
        attachment = sample.attachment if self._traces else None
        parent = "" if attachment is None else attached(attachment.to_bytes())
        receive(Packet(key, data, size, str(sample.encoding), wall_ns, now_ns, parent))

    # Sending

    def announce(self) -> None:
        """Say that this instance is alive; to be called when it is ready."""
        self._alive = self._client.token(self._keys.alive(self._instance))

    def open_publisher(self, stream: str, *, events: bool = False, now: bool = False) -> StreamPublisher:
        """Open the publishers of a stream: of its tracks, and with `events` and `now` of those.

        Say that this instance tracks it, and declare its inputs' keys.
        """

        # Who subscribes asks the caches, and hears by heartbeats of missed messages: no token is needed for that, and
        # each costs the router more the more there are.
        def sender(key: str, kind: type[schemas.Message]) -> Sender:
            return self._client.cached_sender(key, schemas.encoding_of(kind), cache=TRACKS_CACHE, detected=False)

        tracks = sender(self._keys.tracks(stream), schemas.Tracks)
        other = sender(self._keys.events(stream), schemas.Events) if events else None
        encoding = schemas.encoding_of(schemas.Tracks)
        latest = self._client.sender(self._keys.now(stream), encoding, express=True) if now else None
        token = self._client.token(self._keys.owner(stream, self._instance))
        inputs = (self._keys.detections(stream), self._keys.points(stream)) if self._all else ()
        return StreamPublisher(tracks, other, latest, (token, *map(self._client.declare_key, inputs)))

    def watch_owners(self, on_owner: Callable[[str, str, bool], None] | None) -> None:
        """Tell which instance tracks which stream, or does so no longer (False), from now on; None: stop telling."""
        if self._owners is not None:
            self._owners.close(0.0)
            self._owners = None
        if on_owner is not None:
            self._owners = self._client.watch(
                self._keys.all_owners(),
                lambda key, present: on_owner(self._keys.stream_of(key), self._keys.instance_of(key), present),
            )

    # The end

    def leave(self) -> None:
        """Say that this instance is alive no longer."""
        if self._alive is not None:
            self._alive.close()
            self._alive = None

    def stop(self, timeout: float) -> None:
        """Receive nothing any more; messages received before are handed over within `timeout` seconds."""
        self.leave()
        for topic in self._topics.values():
            topic.close(timeout)
        self._client.stop(timeout)

    def close(self) -> None:
        """Withdraw everything and close the session."""
        self.stop(timeout=0.2)
        self._client.close(0.0)


def _name(stream: str, *, cached: bool) -> str:
    """Return the name of a subscription; for a moment there may be one with recovery and one without."""
    return stream if cached else f"{stream} plain"


def _log_link(peer: str, kind: str, came: bool) -> None:  # noqa: FBT001 - the signature of a watcher
    log.info("peer_connected" if came else "peer_lost", peer=peer, kind=kind)
