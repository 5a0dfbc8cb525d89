"""Readers of an edge: subscriptions that they share, and what waits for each of them.

A message is received and decoded once for all its readers, and written as JSON once for all that want the same of it,
when the first of them takes it: what a slow reader cannot take is never made. Unused subscriptions are kept for the
next reader, because Zenoh never gives back the number of a key.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import threading
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, TypeVar

import optipmb_schemas as schemas
import structlog
from optipmb_client.merging import FinalEvents
from optipmb_schemas import json_form
from optipmb_schemas.json_form import EVERYTHING, Selection

from optipmb_service.zenoh.client import SharedSubscriptions, Turns

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from optipmb_client.incoming import Answer
    from optipmb_client.zenoh.handles import Reading
    from optipmb_client.zenoh.session import Session
    from optipmb_schemas.json_form import Place

BYTES: Final = 32 * 2**20
"""Bytes that wait at most for one reader, beyond one message of each stream."""

KEPT: Final = 64
"""Subscriptions that are kept without readers."""

BURST: Final = 200
"""Subscriptions of readers that are opened at once."""

PERIOD_S: Final = 7.5
"""Time after which a further one is, in the long run: 11,520 a day, each with a number that Zenoh never gives back."""

WAITING: Final = 256
"""Messages between Zenoh and the thread of a subscription without recovery."""

EVENTS: Final = 1000
"""Events that wait for a reader; one that is slower is to come again."""

PROBLEMS: Final = 16

QUERY_S: Final = 2.0
"""Longest wait for the services."""

TOLERANCE: Final = 0.999
"""Part of a period that counts as a whole one: stamps of real sensors jitter."""

PREDICTED_TOLERANCE: Final = 0.95
"""The same of predicted states: the time of an output jitters by milliseconds."""

REMEMBERED: Final = 64

KINDS: Final[dict[str, type[schemas.Message]]] = {
    "detections": schemas.Detections,
    "tracks": schemas.Tracks,
    "now": schemas.Tracks,
    "events": schemas.Events,
    "problems": schemas.Problem,
}

T = TypeVar("T")
M = TypeVar("M", bound=schemas.Message)

log = structlog.get_logger("optipmb_service")


class Outbox(Generic[T]):
    """Bounded queue of what waits for one reader; the newest win. To be made and read on the reader's loop.

    Streams take turns, so that one of them cannot hide the others.

    Args:
        per_stream: items of one stream that may wait.
    """

    def __init__(self, per_stream: int = 1) -> None:
        self._per_stream = per_stream
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._waiting: dict[str, collections.deque[tuple[T, int]]] = {}
        self._bytes = 0
        self._skipped = 0
        self._changed = asyncio.Event()
        self._closed = False
        self.left_out = 0
        """Items left out since the beginning."""

    def put(self, stream: str, item: T, size: int, most: int = 0) -> int:
        """Add an item on any thread, and return how many of its stream were left out for it; `most` may wait."""
        with self._lock:
            was_empty = not self._waiting
            queue = self._waiting.setdefault(stream, collections.deque())
            queue.append((item, size))
            self._bytes += size
            left_out = 0
            while len(queue) > (most or self._per_stream) or (self._bytes > BYTES and len(queue) > 1):
                self._bytes -= queue.popleft()[1]
                left_out += 1
            self._skipped += left_out
            self.left_out += left_out
        if was_empty:
            self._wake()
        return left_out

    def replace(self, item: T, size: int) -> None:
        """Add an item that replaces the waiting one of its kind."""
        with self._lock:
            self._bytes += size - sum(before for _, before in self._waiting.get("", ()))
            self._waiting[""] = collections.deque([(item, size)])
        self._wake()

    def close(self) -> None:
        """Say that nothing follows."""
        self._closed = True
        self._wake()

    async def take(self, seconds: float | None = None) -> tuple[T, int] | None:
        """Return the next item, and how many were left out before it; None when there is none and nothing follows.

        Raises:
            TimeoutError: none has come in so long.
        """
        while (taken := self.take_now()) is None:
            with self._lock:
                if self._waiting:
                    continue
                if self._closed:
                    return None
                self._changed.clear()
            await asyncio.wait_for(self._changed.wait(), seconds)
        return taken

    def take_now(self) -> tuple[T, int] | None:
        """Return the next item, and how many were left out before it; None when none waits."""
        with self._lock:
            if not self._waiting:
                return None
            stream, queue = next(iter(self._waiting.items()))
            item, size = queue.popleft()
            self._bytes -= size
            del self._waiting[stream]
            if queue:
                self._waiting[stream] = queue  # behind the others
            skipped, self._skipped = self._skipped, 0
            return item, skipped

    def _wake(self) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._changed.set)


class Pace:
    """Leaves out frames that come sooner than a period after the one before, in sensor time, in each stream.

    What corrects a frame that was let through is let through too.

    Args:
        max_rate_hz: highest rate; 0: all frames.
        predict: whether the stamps are times of predicted states, which nothing corrects.

    Raises:
        MessageError: it is no rate.
    """

    def __init__(self, max_rate_hz: float, *, predict: bool = False) -> None:
        if not 0 <= max_rate_hz < float("inf"):
            raise schemas.MessageError("invalid_value", "max_rate_hz", "a rate in Hz, or 0", f"{max_rate_hz:g}")
        tolerance = PREDICTED_TOLERANCE if predict else TOLERANCE
        self._period_ns = tolerance * 1e9 / max_rate_hz if max_rate_hz else 0.0
        self._predict = predict
        self._passed: dict[str, collections.deque[int]] = {}

    def passes(self, stream: str, stamp_ns: int) -> bool:
        """Tell whether the tracks of a frame are sent."""
        if not self._period_ns:
            return True
        passed = self._passed.setdefault(stream, collections.deque(maxlen=REMEMBERED))
        if stamp_ns in passed:
            return not self._predict
        if passed and abs(stamp_ns - passed[-1]) < self._period_ns:
            return False
        passed.append(stamp_ns)
        return True


class Publication:
    """A message that has arrived, read and written once for all readers.

    Attributes:
        topic: the last part of its key.
    """

    def __init__(self, key: str, payload: bytes, encoding: str, places: Mapping[str, Place]) -> None:
        self.topic = key.rpartition("/")[2]
        self.payload = payload
        self.encoding = encoding
        self._places = places
        self._texts: dict[Selection, bytes] = {}

    @cached_property
    def message(self) -> Any:
        """The message; None where it is not valid."""
        return _valid(KINDS[self.topic], self)

    @property
    def place(self) -> Place | None:
        """Place of its site."""
        return self._places.get(self.message.stream.partition("/")[0])

    def tracks(self, selection: Selection = EVERYTHING) -> bytes:
        """Return the selection of its tracks as JSON."""
        if selection not in self._texts:
            self._texts[selection] = json_form.tracks_json(self.message, selection, self.place)
        return self._texts[selection]

    @cached_property
    def events(self) -> list[bytes]:
        """Its events as JSON."""
        return json_form.event_json(self.message, self.place)

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


@dataclass(frozen=True)
class Wish:
    """What a reader wants: patterns of streams, topics, which tracks, and how often."""

    streams: tuple[str, ...]
    topics: frozenset[str]
    selection: Selection = EVERYTHING
    max_rate_hz: float = 0.0
    final: bool = True
    """Whether it gets events when they do not change any more, each once, or as they are published."""
    predict: bool = False
    """Whether it gets tracks at a fixed rate, predicted to now."""

    def keys(self, keys: schemas.Keys) -> list[str]:
        """Return the keys to subscribe to.

        Raises:
            MessageError: a pattern is none.
        """
        named = {"zones": "events", "tracks": "now" if self.predict else "tracks"}
        topics = {named.get(topic, topic) for topic in self.topics}
        return [keys.matching(one, topic) for topic in sorted(topics) for one in self.streams]  # type: ignore[arg-type]


class Reader:
    """Queue of the texts for one reader. To be made and read on its loop.

    Args:
        wish: its streams and topics.
        events: how many events may wait; beyond, the oldest are lost.
    """

    def __init__(self, wish: Wish, events: int = EVENTS) -> None:
        self.outbox: Outbox[Text] = Outbox()
        self.lost_events = 0
        self._events = events
        self._held: dict[str, FinalEvents] = collections.defaultdict(FinalEvents)
        self.want(wish)

    def want(self, wish: Wish) -> None:
        """Change its streams and topics."""
        self._wish, self._pace = wish, Pace(wish.max_rate_hz, predict=wish.predict)

    async def take(self, seconds: float | None = None) -> bytes | None:
        """Return the next text; None when events were lost, and the reader is to come again.

        Raises:
            TimeoutError: none has come in so long.
        """
        taken = await self.outbox.take(seconds)
        if taken is None or self.lost_events:
            return None
        return json_form.with_skipped(taken[0].make(), taken[1])

    def receive(self, one: Publication) -> None:
        """Take a message, on any thread."""
        message, topics = one.message, self._wish.topics
        if message is None:
            return
        stream, size, put = message.stream, len(one.payload), self.outbox.put
        if one.topic in {"tracks", "now"}:
            if self._pace.passes(stream, message.predicted_to_ns or message.stamp_ns):
                put(f"tracks {stream}", Text("tracks", stream, partial(one.tracks, self._wish.selection)), size)
        elif one.topic == "problems":
            text = Text("problems", stream, partial(json_form.problem_json, message))
            put(f"problems {stream}", text, size, PROBLEMS)
        elif one.topic == "events":
            for event in self._due(one) if "events" in topics else ():
                text = Text("events", stream, partial(bytes, event))
                self.lost_events += put("events", text, len(event), self._events)
            if "zones" in topics and (counts := one.zones) is not None:
                put(f"zones {stream}", Text("zones", stream, partial(bytes, counts)), len(counts))

    def _due(self, one: Publication) -> list[bytes]:
        if not self._wish.final:
            return one.events
        due = self._held[one.message.stream].take(one.message)
        return [text for message in due for text in json_form.event_json(message, one.place)]


class Feeds:
    """Subscriptions of readers in this process. For any threads.

    Args:
        session: on the network.
        places: of sites.
    """

    def __init__(self, session: Session, places: Mapping[str, Place]) -> None:
        self.session = session
        self._places = places
        self._turns = Turns(BURST, PERIOD_S)
        self._shared: SharedSubscriptions[Callable[[Publication], None], Publication]
        self._shared = SharedSubscriptions(self._subscribe, _deliver, KEPT)

    def join(self, keys: Iterable[str], receive: Callable[[Publication], None]) -> Callable[[], None]:
        """Hand over publications under key expressions until the result is called, which may be twice; may wait.

        Raises:
            TransportError: the network cannot be used, or too many keys were asked for.
        """
        with contextlib.ExitStack() as joined:
            for key in keys:
                joined.callback(self._shared.join(key, receive))
            return joined.pop_all().close

    def _subscribe(self, key: str, receive: Callable[[Publication], None]) -> Reading:
        """Subscribe: to events with recovery and history, to other topics without."""
        self._turns.take()
        if key.endswith("/events"):
            return self.session.subscribe(
                key, lambda one: receive(Publication(one.key, one.payload, one.encoding, self._places)), history=True
            )

        def read(sample: Any) -> None:
            receive(Publication(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding), self._places))

        return self.session.read_newest(key, read, most=1 if key.endswith("/detections") else WAITING)

    def newest(self, key: str, most: int = 1) -> list[Publication]:
        """Return the newest messages of each publisher's cache under a key expression; may wait.

        Raises:
            TransportError: the network cannot be used.
        """
        answers = self.session.query(f"{key}/@adv/**?_max={most}", timeout=QUERY_S)
        return [Publication(one.key, one.payload, one.encoding, self._places) for one in answers if one.ok]


async def listed(session: Session, keys: schemas.Keys, pattern: str) -> list[tuple[str, schemas.SessionSummary]]:
    """Return the sessions of a pattern by stream, each with its service.

    Workers, who answer too, are no services: their parent speaks for them.

    Raises:
        TransportError: the network cannot be used.
    """
    answers, alive = await asyncio.gather(
        asyncio.to_thread(session.query, keys.all_status(), timeout=QUERY_S),
        asyncio.to_thread(session.alive, keys.all_alive(), timeout=QUERY_S),
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
