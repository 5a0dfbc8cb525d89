"""Readers of an edge: their shared subscriptions, and what each of them takes.

A message is received and decoded once for all its readers, and written as JSON once for all that want the same of it,
when the first of them takes it: what a slow reader cannot take is never made. Unused subscriptions are kept for the
next reader, because Zenoh never gives back the number of a key.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import threading
import time
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import takewhile
from math import inf
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import optipmb_schemas as schemas
import structlog
from optipmb_client.merging import FinalEventsOfStreams
from optipmb_schemas import json_form
from optipmb_schemas.json_form import EVERYTHING, Selection

from optipmb_service.edges.global_ids import GlobalIds
from optipmb_service.edges.queues import Outbox, Pace
from optipmb_service.zenoh.client import SharedSubscriptions, Turns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from optipmb_client.incoming import Answer, Arrival
    from optipmb_client.zenoh.handles import Dispatcher
    from optipmb_client.zenoh.session import ZenohSession
    from optipmb_schemas.json_form import Place

    from optipmb_service.settings import Settings

KEPT: Final = 64
"""Subscriptions that are kept without readers."""

BURST: Final = 200
"""Subscriptions of readers that are opened at once."""

PERIOD_S: Final = 7.5
"""Mean time between two new subscriptions: 11,520 a day, each with a number that Zenoh never gives back."""

WAITING: Final = 256
"""Messages between Zenoh and the thread of a subscription without recovery."""

IDLE_LOGS: Final = 16
"""Subscriptions to events that are kept without readers."""

BEGINNING: Final = "0"
"""Id with which a new reader of events gets all kept events."""

DIGITS: Final = 20
PROBLEMS: Final = 16
TRACKS: Final = ("/tracks", "/now")
"""Ends of keys of tracks."""

KINDS: Final[dict[str, type[schemas.Message]]] = {
    "detections": schemas.Detections,
    "tracks": schemas.Tracks,
    "now": schemas.Tracks,
    "events": schemas.Events,
    "problems": schemas.Problem,
}

M = TypeVar("M", bound=schemas.Message)

log = structlog.get_logger("optipmb_service")


class Publication:
    """A message that has arrived, read and written once for all readers.

    Attributes:
        topic: the last part of its key.

    Args:
        ids: of linked tracks.
        live: whether it has just come, and is not from a cache.
    """

    def __init__(
        self,
        key: str,
        payload: bytes,
        encoding: str,
        places: Mapping[str, Place],
        ids: GlobalIds | None = None,
        *,
        live: bool = True,
    ) -> None:
        self.topic = key.rpartition("/")[2]
        self.payload = payload
        self.encoding = encoding
        self.arrived = time.monotonic() if live else None
        self._places = places
        self._ids = ids
        self._texts: dict[Selection, bytes] = {}

    @cached_property
    def message(self) -> Any:
        """The message; None where it is not valid."""
        return _valid(KINDS[self.topic], self)

    @property
    def place(self) -> Place | None:
        return self._places.get(self.message.stream.partition("/")[0])

    @property
    def global_ids(self) -> Sequence[str]:
        """Global ids of its tracks, as far as they are known now."""
        return () if self._ids is None else self._ids.of(self.message)

    @property
    def age_s(self) -> float:
        """Seconds since it came, or since it was published if it is from a cache."""
        if self.arrived is not None:
            return time.monotonic() - self.arrived
        delivery = self.message.delivery
        return 0.0 if delivery is None else max(0.0, (time.time_ns() - delivery.published_ns) / 1e9)

    def tracks(self, selection: Selection, stale_s: float) -> bytes:
        """Return the selection of its tracks as JSON, with their age."""
        if selection not in self._texts:
            self._texts[selection] = json_form.tracks_json(self.message, selection, self.place, self.global_ids)
        age_s = self.age_s
        return json_form.with_age(self._texts[selection], age_s, stale=age_s > stale_s)

    @cached_property
    def zones(self) -> bytes | None:
        """Its counts of zones as JSON; None without any."""
        return json_form.zones_json(self.message)


def _valid(kind: type[M], one: Publication | Answer) -> M | None:
    """Return the message that came; None for one that is not valid, which is logged."""
    try:
        return schemas.decode(one.payload, kind, encoding=one.encoding)
    except schemas.MessageError as error:
        log.warning("edge_invalid", reason=str(error))
        return None


class Text(NamedTuple):
    """A text that waits for a reader."""

    topic: str
    stream: str
    make: Callable[[], bytes]
    event_id: str = ""


class Bounds(NamedTuple):
    """Bounds of an event log: events of one stream, their age, and bytes of all."""

    events: int = 1000
    seconds: float = 600.0
    size: int = 4 * 2**20


BOUNDS: Final = Bounds()


class LoggedEvent(NamedTuple):
    """An event in a log; `at` is the monotonic time at which it came."""

    number: int
    at: float
    stream: str
    text: bytes


class EventLog:
    """The newest events of one subscription, numbered as they come, from which readers take. For any threads.

    A returning reader continues after its last event, and learns how many events were dropped since.

    Args:
        final: whether it holds events when they do not change any more, each once, or as they are published.
    """

    def __init__(self, bounds: Bounds, *, final: bool) -> None:
        self._bounds = bounds
        self._is_final = final
        self._name = f"{time.time_ns():x}"
        self._lock = threading.Lock()
        self._held = FinalEventsOfStreams()
        self._kept: dict[int, LoggedEvent] = {}
        self._numbers: dict[str, collections.deque[int]] = {}
        self._size = 0
        self._last = 0
        self._entered = False

    def add(self, one: Publication) -> None:
        """Add the events of a message, or the events that it makes final."""
        message: schemas.Events = one.message
        with self._lock:
            for each in self._held.take(message) if self._is_final else [message]:
                for text in json_form.event_json(each, one.place):
                    self._last += 1
                    self._kept[self._last] = LoggedEvent(self._last, time.monotonic(), message.stream, text)
                    self._size += len(text)
                    numbers = self._numbers.setdefault(message.stream, collections.deque())
                    numbers.append(self._last)
                    if len(numbers) > self._bounds.events:
                        self._drop(numbers[0])
            self._expire()

    def enter(self, after: str) -> int | None:
        """Return the number after which a reader begins, by the id that it has; None where that is not known here.

        The first reader begins with what the services still had when it came; others without an id begin now.
        """
        name, _, number = after.partition("-")
        with self._lock:
            begins, self._entered = self._last if self._entered else 0, True
            if not after:
                return begins
            if after == BEGINNING:
                return 0
            if name != self._name or not (number.isascii() and number.isdigit() and len(number) < DIGITS):
                return None
            return min(int(number), self._last)

    def after(self, number: int) -> tuple[list[LoggedEvent], int]:
        """Return the events after a number, and the count of dropped ones."""
        with self._lock:
            self._expire()
            found = list(takewhile(lambda one: one.number > number, reversed(self._kept.values())))
            return found[::-1], self._last - number - len(found)

    def id_of(self, number: int) -> str:
        """Return the id with which a reader continues after an event."""
        return f"{self._name}-{number}"

    def _expire(self) -> None:
        until = time.monotonic() - self._bounds.seconds
        while self._kept and (self._size > self._bounds.size or next(iter(self._kept.values())).at < until):
            self._drop(next(iter(self._kept)))

    def _drop(self, number: int) -> None:
        """Drop an event, the oldest of its stream."""
        event = self._kept.pop(number)
        self._size -= len(event.text)
        numbers = self._numbers[event.stream]
        numbers.popleft()
        if not numbers:
            del self._numbers[event.stream]


@dataclass(frozen=True)
class Wish:
    """Request of a reader: patterns of streams, topics, selection of tracks, rate."""

    streams: tuple[str, ...]
    topics: frozenset[str]
    selection: Selection = EVERYTHING
    max_rate_hz: float = 0.0
    final: bool = True
    """Whether events come once, when they are final, or as they are published."""
    predict: bool = False
    """Whether it gets tracks at a fixed rate, predicted to now."""
    after: str = ""
    """Id of the last event of the reader; later ones are sent, too."""

    def keys(self, keys: schemas.Keys) -> list[str]:
        """Return the keys to subscribe to.

        Raises:
            MessageError: a pattern is none.
        """
        named = {"zones": "events", "tracks": "now" if self.predict else "tracks", "cpm": "tracks"}
        topics = {named.get(topic, topic) for topic in self.topics}
        try:
            return [keys.matching(one, topic) for topic in sorted(topics) for one in self.streams]  # type: ignore[arg-type]
        except schemas.MessageError as error:
            raise schemas.MessageError(error.code, "stream", error.expected, error.received) from None


Logs = dict[bool, EventLog]
"""The final events of a subscription (True), and all as they are published."""

Shared = SharedSubscriptions["Callable[[Publication], None]", Publication]


class Reader:
    """Queue of the texts for one reader. To be made and read on its loop.

    Args:
        wish: its streams and topics.
        stale_s: a stream without frames for so long is said to be stale, once.
    """

    def __init__(self, wish: Wish, stale_s: float) -> None:
        self.outbox: Outbox[Text | None] = Outbox()  # None: a log has events
        self._stale_s = stale_s
        self._lock = threading.Lock()
        self._newest: dict[str, Publication] = {}
        self._numbers: dict[EventLog, int] = {}
        self._events: collections.deque[Text] = collections.deque()
        self._missed = 0
        self.want(wish)

    def want(self, wish: Wish) -> None:
        """Change its streams and topics."""
        self._wish, self._pace = wish, Pace(wish.max_rate_hz, predict=wish.predict)
        with self._lock:
            self._newest.clear()

    def read(self, logs: Iterable[Logs]) -> str:
        """Read events from these logs, and return the id after which it begins in the last of them."""
        wish, before, self._numbers = self._wish, self._numbers, {}
        event_id = ""
        for log in (each[wish.final] for each in logs if "events" in wish.topics):
            number = before.get(log) if not wish.after else None  # it goes on where it was
            if number is None:
                self._events.clear()
                if (number := log.enter(wish.after)) is None:
                    self._events.append(self._missing(None))
            self._numbers[log] = number or 0
            event_id = log.id_of(number or 0)
        self.outbox.replace(None, 0)
        return event_id

    @property
    def lost_events(self) -> int:
        """Events that were dropped because the reader was too slow."""
        return self._missed + sum(log.after(number)[1] for log, number in tuple(self._numbers.items()))

    async def take(self, seconds: float | None = None) -> tuple[bytes, str]:
        """Return the next text, and its id if it is an event.

        Raises:
            TimeoutError: none has come in so long.
        """
        text, skipped = await self.take_text(seconds)
        made = text.make()
        if text.event_id:
            made = json_form.with_event_id(made, text.event_id)
        return json_form.with_skipped(made, skipped), text.event_id

    async def take_text(self, seconds: float | None = None) -> tuple[Text, int]:
        """Return the next text, and how many were left out before it. Raises TimeoutError as `take` does."""
        ends = inf if seconds is None else time.monotonic() + seconds
        while (taken := self.take_now()) is None:
            with self._lock:
                oldest = next(iter(self._newest.values()), None)
            stale = inf if oldest is None else time.monotonic() + self._stale_s - oldest.age_s
            until = min(ends, stale)
            try:
                await self.outbox.wait(None if until == inf else max(0.0, until - time.monotonic()))
            except TimeoutError:
                if ends <= stale:
                    raise
        return taken

    def take_now(self) -> tuple[Text, int] | None:
        """Return the next text, and how many were left out before it; None when none waits."""
        skipped = 0
        while (taken := self.outbox.take_now()) is not None:
            skipped += taken[1]
            if (text := taken[0] or self._event()) is not None:
                return text, skipped
        return None if (text := self._stale()) is None else (text, 0)

    def receive(self, one: Publication) -> None:
        """Take a message, on any thread."""
        message, topics = one.message, self._wish.topics
        if message is None:
            return
        stream, size, put = message.stream, len(one.payload), self.outbox.put
        if one.topic in {"tracks", "now"} and "tracks" in topics:
            with self._lock:
                self._newest.pop(stream, None)
                self._newest[stream] = one  # the newest is last
            if self._pace.passes(stream, message.predicted_to_ns or message.stamp_ns):
                put(f"tracks {stream}", self._tracks(one), size)
        elif one.topic == "problems":
            text = Text("problems", stream, partial(json_form.problem_json, message))
            put(f"problems {stream}", text, size, PROBLEMS)
        elif one.topic == "events":
            if "events" in topics:
                self.outbox.replace(None, 0)
            if "zones" in topics and (counts := one.zones) is not None:
                put(f"zones {stream}", Text("zones", stream, partial(bytes, counts)), len(counts))

    def _tracks(self, one: Publication) -> Text:
        return Text("tracks", one.message.stream, partial(one.tracks, self._wish.selection, self._stale_s))

    def _stale(self) -> Text | None:
        """Return the newest tracks of a stream that has just become stale."""
        with self._lock:
            one = next(iter(self._newest.values()), None)
            if one is None or one.age_s <= self._stale_s:
                return None
            del self._newest[one.message.stream]
        return self._tracks(one)

    def _event(self) -> Text | None:
        """Return the next event of the logs, or how many it was too slow for; None when there is none."""
        for log, number in () if self._events else tuple(self._numbers.items()):
            found, missed = log.after(number)
            if missed:
                self._missed += missed
                self._events.append(self._missing(missed))
            for each in found:
                self._events.append(Text("events", each.stream, partial(bytes, each.text), log.id_of(each.number)))
            self._numbers[log] = number + missed + len(found)
        if not self._events:
            return None
        self.outbox.replace(None, 0)  # the other streams have their turns
        return self._events.popleft()

    def _missing(self, events: int | None) -> Text:
        pattern = self._wish.streams[0]
        return Text("events", pattern, partial(json_form.missed_json, pattern, events))


class Feeds:
    """Subscriptions of readers in this process. For any threads.

    Args:
        session: on the network.
        keys: of the network.
        places: of sites.
        bounds: of the events of each subscription.
    """

    def __init__(
        self, session: ZenohSession, keys: schemas.Keys, places: Mapping[str, Place], bounds: Bounds = BOUNDS
    ) -> None:
        self.session = session
        self._keys = keys
        self._ids = GlobalIds()
        self._linking = threading.Lock()
        self._links: Dispatcher | None = None
        self._places = places
        self._bounds = bounds
        self._turns = Turns(BURST, PERIOD_S)
        self._logs: dict[str, Logs] = {}
        self._shared: Shared = SharedSubscriptions(self._subscribe, _deliver, KEPT)
        self._events: Shared = SharedSubscriptions(self._subscribe_events, _deliver, IDLE_LOGS, bounds.seconds)

    def join(self, keys: Iterable[str], receive: Callable[[Publication], None]) -> Callable[[], None]:
        """Hand over publications under key expressions until the result is called, which may be twice; may wait.

        Raises:
            TransportError: the network cannot be used, or too many keys were asked for.
        """
        with contextlib.ExitStack() as joined:
            for key in keys:
                if key.endswith(TRACKS):
                    self._read_links()
                shared = self._events if key.endswith("/events") else self._shared
                joined.callback(shared.join(key, receive))
            return joined.pop_all().close

    def logs(self, keys: Iterable[str]) -> list[Logs]:
        """Return the events of the joined ones of these keys."""
        return [logs for key in keys if (logs := self._logs.get(key)) is not None]

    def _subscribe_events(self, key: str, receive: Callable[[Publication], None]) -> contextlib.ExitStack:
        """Subscribe to events, with recovery and history, and keep them."""
        self._turns.take()
        logs = {final: EventLog(self._bounds, final=final) for final in (True, False)}

        def read(one: Arrival) -> None:
            publication = Publication(one.key, one.payload, one.encoding, self._places, self._ids)
            if publication.message is not None:
                for log in logs.values():
                    log.add(publication)
            receive(publication)

        def forget() -> None:
            if self._logs.get(key) is logs:  # else it has been subscribed to again
                del self._logs[key]

        self._logs[key] = logs
        with contextlib.ExitStack() as closing:
            closing.callback(forget)
            closing.callback(self.session.subscribe(key, read, history=True).close)
            return closing.pop_all()

    def _subscribe(self, key: str, receive: Callable[[Publication], None]) -> Dispatcher:
        self._turns.take()

        def read(sample: Any) -> None:
            content = sample.payload.to_bytes(), str(sample.encoding)
            receive(Publication(str(sample.key_expr), *content, self._places, self._ids))

        return self.session.read_newest(key, read, most=1 if key.endswith("/detections") else WAITING)

    def newest(self, key: str, most: int = 1) -> list[Publication]:
        """Return the newest messages of each publisher's cache under a key expression; may wait.

        Raises:
            TransportError: the network cannot be used.
        """
        if key.endswith(TRACKS):
            self._read_links()
        answers = self.session.query(f"{key}/@adv/**?_max={most}")
        about = self._places, self._ids
        return [Publication(one.key, one.payload, one.encoding, *about, live=False) for one in answers if one.ok]

    def _read_links(self) -> None:
        """Begin to read the links of all areas, also the present ones, before the first tracks are read."""
        with self._linking:
            if self._links is not None:
                return
            self._links = self.session.read_newest(self._keys.all_links(), self._take_links, most=WAITING)
            for answer in self.session.query(self._keys.all_links_query()):
                if answer.ok and (links := _valid(schemas.Links, answer)) is not None:
                    self._ids.take(links)

    def _take_links(self, sample: Any) -> None:
        content = Publication(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), {})
        if (links := _valid(schemas.Links, content)) is not None:
            self._ids.take(links)


async def listed(session: ZenohSession, keys: schemas.Keys, pattern: str) -> list[tuple[str, schemas.SessionSummary]]:
    """Return the sessions of a pattern by stream, each with its service.

    Answers of workers are left out: their parent answers for them.

    Raises:
        TransportError: the network cannot be used.
    """
    answers, alive = await asyncio.gather(
        asyncio.to_thread(session.query, keys.all_status()),
        asyncio.to_thread(session.alive, keys.all_alive()),
    )
    services = {keys.instance_of(key) for key in alive}
    found = []
    for answer in answers:
        status = _valid(schemas.ServiceStatus, answer) if answer.ok else None
        if status is not None and status.instance in services:
            found += [(status.instance, one) for one in status.sessions if _matches(one.stream, pattern)]
    return sorted(found, key=lambda entry: (entry[1].stream, entry[0]))


def _matches(stream: str, pattern: str) -> bool:
    return all(want in {"*", part} for part, want in zip(stream.split("/"), pattern.split("/"), strict=True))


def _deliver(receivers: tuple[Callable[[Publication], None], ...], one: Publication) -> None:
    for receive in receivers:
        receive(one)


def places_of(settings: Settings) -> dict[str, Place]:
    """Return the places of sites whose world frames have one."""
    if not settings.sites:
        return {}
    from optipmb import Georeference  # noqa: PLC0415 - the tracker, which a router does not load

    return {name: Georeference(site.origin, site.x_heading).to_geographic for name, site in settings.sites.items()}
