"""Receiving tracks, for programs of your own.

Tracks are in the fixed world frame: metres, radians, stamps in integer nanoseconds of the sensor's clock.
"""

import collections
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Self, TypeVar

from optipmb_schemas import PREFIX, Events, Keys, Message, MessageError, Problem, Topic, Tracks

from optipmb_client.incoming import Arrival, Inbox
from optipmb_client.links import Link, linked
from optipmb_client.merging import FinalEventsOfStreams, Merging, Novelty, remember

__all__ = ["EventSubscriber", "Missed", "Received", "Statistics", "Subscriber"]

REMEMBERED = 65_536  # frames whose repetition is recognised
RECOVERED_NS = 500_000_000  # delay from which tracks count as recovered
MISSED = 1024  # ranges of lost frames that are kept

_Message = TypeVar("_Message", bound=Message)


@dataclass(frozen=True)
class Received:
    """Tracks, and the monotonic time (`time.monotonic_ns`) at which they arrived on this machine.

    `corrects` says whether they replace earlier tracks of the same frame. `recovered` says that they come late:
    half a second later than others of the stream did, after a loss on the way, or with `history` from before the
    subscription, by the clocks of both machines. `traceparent` is the W3C trace context in which the service published
    them; empty where it records no traces, and over gRPC.
    """

    tracks: Tracks
    monotonic_ns: int
    corrects: bool = False
    traceparent: str = ""
    recovered: bool = False


@dataclass(frozen=True)
class Missed:
    """Frames whose tracks were lost: the link was gone for longer than they are kept, or the program was too slow.

    Where `optipmb-service log` runs, `kept_tracks(connection, missed.stream, missed.after_ns, missed.before_ns)` gets
    them. Frames of the range that were refused or never came have no tracks.

    Attributes:
        stream: Name of the stream.
        sensor: Whose frames, where several sensors share a session; else None.
        epoch: Run of the publisher.
        first: Number of the first frame.
        last: Number of the last one; None: up to the end of that run.
        after_ns: Stamp of the frame before.
        before_ns: Stamp of the frame behind.
    """

    stream: str
    sensor: str | None
    epoch: bytes
    first: int
    last: int | None
    after_ns: int
    before_ns: int


@dataclass(frozen=True)
class Statistics:
    """Messages of a subscriber: given out, dropped (the program was too slow), repeated, not valid, waiting.

    `corrected` counts the messages that replaced an earlier one, whether they were given out or not, `missed` the
    ranges of frames whose tracks were lost (`Subscriber.missed`).
    """

    delivered: int
    dropped: int
    repeated: int
    invalid: int
    pending: int
    corrected: int = 0
    missed: int = 0


class _Subscription:
    """Topics of a pattern, on a connection of its own, which `opened` gives, or a shared one."""

    def __init__(
        self,
        pattern: str,
        topics: Sequence[Topic],
        queue: int,
        prefix: str,
        connection: "Link | None",
        opened: Callable[[], Link],
        *,
        history: bool,
    ) -> None:
        Keys(prefix).matching(pattern, "tracks")  # checks both
        self._counts = collections.Counter[str]()
        self._inbox = Inbox(queue)
        self._own: Link | None = None
        if connection is None:
            connection = self._own = opened()
        self._subscription = connection.subscribe_streams(pattern, self._inbox, *topics, prefix=prefix, history=history)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the subscription; a loop over it gets what still waits, then ends. May be called twice."""
        self._subscription.close()
        self._inbox.close()
        if self._own is not None:
            self._own.close()

    @property
    def statistics(self) -> Statistics:
        """Counts since the subscriber was made."""
        names = ("delivered", "repeated", "invalid", "corrected", "missed")
        counts = {name: self._counts[name] for name in names}
        return Statistics(dropped=self._inbox.dropped, pending=self._inbox.pending, **counts)

    def _read(self, arrival: Arrival, kind: type[_Message]) -> _Message | None:
        """Return the message that arrived; None for one that is not valid, which is counted."""
        try:
            return arrival.read(kind)
        except MessageError:
            self._counts["invalid"] += 1
            return None


class EventSubscriber(_Subscription):
    """Iterates over the events of zones and lines of one stream or of many.

    Args:
        pattern: Name of a stream, `site/node/sensor`, or a pattern with `*` in the place of names: `garage/*/*`.
        connect: As for `Subscriber`, like all options that are not named here.
        final: Give out each message once it does not change any more, in order: to count. Else give out all at once,
            with corrections of earlier ones: to raise alarms.
        timeout: Iterating ends when nothing has come for so many seconds; None: never.

    Raises:
        ConnectionFailed: No router, or gateway, within `connect_timeout`, or `connection` is used up.
        MessageError: `pattern` is neither the name of a stream nor such a pattern.
    """

    def __init__(  # noqa: PLR0913  each option by its name, all but two seldom used
        self,
        pattern: str,
        connect: str | Sequence[str] | None = None,
        *,
        final: bool = True,
        timeout: float | None = None,
        queue: int = 1024,
        config: str | Path | None = None,
        connection: "Link | None" = None,
        connect_timeout: float = 5.0,
        prefix: str = PREFIX,
    ) -> None:
        self.timeout = timeout
        self._final = final
        self._streams = FinalEventsOfStreams()
        opened = partial(linked, connect, config=config, timeout=connect_timeout)
        super().__init__(pattern, ("events",), queue, prefix, connection, opened, history=True)

    def __iter__(self) -> Iterator[Events]:
        """Iterate over the messages until `timeout` or `close`.

        Raises:
            ServiceRefused: the gateway has ended the subscription for good.
        """
        while (arrival := self._inbox.get(self.timeout)) is not None:
            if (message := self._read(arrival, Events)) is not None:
                for one in self._streams.take(message) if self._final else (message,):
                    self._counts["delivered"] += 1
                    yield one


class Subscriber(_Subscription):
    """Receives the tracks of one stream or of many.

    Iterating gives `Tracks` messages as they come. The service may deliver a message again, after a restart for
    example: repetitions are left out, so that every message is given out once. When the service gets a frame late, it
    inserts it and publishes the tracks of the frames behind it again, with a higher `revision`: the latest one
    of a frame holds. `corrections=False` leaves these out, for programs that act on new frames alone.

    Tracks come from now on; lost messages are recovered while the stream goes on. With `history` a late subscriber
    first gets the messages that the service keeps: some seconds of each stream, also of ended ones. A program that is
    too slow loses the oldest of its own waiting messages; `statistics` counts them, and `missed` names the frames.

    Args:
        pattern: Name of a stream, `site/node/sensor`, or a pattern with `*` in the place of names: `garage/*/*`.
        connect: Endpoint or endpoints of routers, such as `tcp/10.0.0.1:7447`, or of gRPC gateways, such as
            `grpc://10.0.0.1:50051`; default: this machine.
        timeout: Iterating ends when nothing has come for so many seconds; None: never.
        on_problem: Called with each `Problem` that the service reports for these streams (refused messages and the
            like), by the thread that iterates.
        corrections: Whether messages that replace earlier ones are given out too.
        history: Give out the kept earlier messages first.
        predict: Receive tracks predicted to now, at a fixed rate, of the streams in the setting `outputs`: each
            message replaces the one before, and none is kept for late subscribers.
        queue: Number of messages that may wait.
        config: A Zenoh configuration file, for TLS, passwords and the like; for gRPC the folder of the certificates.
        connection: Share an open connection (it stays open) in the place of `connect` and `config`.
        connect_timeout: Seconds to wait for a router.
        prefix: First part of all keys, as configured in the service.

    Raises:
        ConnectionFailed: No router, or gateway, within `connect_timeout`, or `connection` is used up.
        MessageError: `pattern` is neither the name of a stream nor such a pattern.
    """

    def __init__(  # noqa: PLR0913  each option by its name, all but two seldom used
        self,
        pattern: str,
        connect: str | Sequence[str] | None = None,
        *,
        timeout: float | None = None,
        on_problem: Callable[[Problem], None] | None = None,
        corrections: bool = True,
        history: bool = False,
        predict: bool = False,
        queue: int = 1024,
        config: str | Path | None = None,
        connection: "Link | None" = None,
        connect_timeout: float = 5.0,
        prefix: str = PREFIX,
    ) -> None:
        self.timeout = timeout
        self._on_problem = on_problem
        self._merging = Merging(REMEMBERED)
        self._corrections = corrections
        self._newest: collections.OrderedDict[tuple[str, str | None], tuple[bytes, int, int]]
        self._newest = collections.OrderedDict()
        self._missed: collections.deque[Missed] = collections.deque(maxlen=MISSED)
        tracks: Topic = "now" if predict else "tracks"
        topics: tuple[Topic, ...] = (tracks,) if on_problem is None else (tracks, "problems")
        opened = partial(linked, connect, config=config, timeout=connect_timeout)
        self._fastest_ns: collections.OrderedDict[str, int] = collections.OrderedDict()
        self._began_ns = time.time_ns() if history else 0
        super().__init__(pattern, topics, queue, prefix, connection, opened, history=history)

    def __iter__(self) -> Iterator[Tracks]:
        """Iterate over the messages until `timeout` or `close`.

        Raises:
            ServiceRefused: the gateway has ended the subscription for good.
        """
        while (received := self.receive(self.timeout)) is not None:
            yield received.tracks

    def receive(self, timeout: float | None = None) -> Received | None:
        """Return the next tracks, waiting up to `timeout` seconds (None: for ever); None when none came.

        Raises:
            ServiceRefused: the gateway has ended the subscription for good; raised once.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        while True:
            left = None if deadline is None else max(0.0, deadline - time.monotonic())
            arrival = self._inbox.get(left)
            if arrival is None:
                return None
            if arrival.key.endswith("/problems"):
                if (problem := self._read(arrival, Problem)) is not None and self._on_problem is not None:
                    self._on_problem(problem)
            elif (tracks := self._read(arrival, Tracks)) is not None:
                if tracks.predicted_to_ns is not None:
                    self._counts["delivered"] += 1
                    return Received(tracks, arrival.monotonic_ns)
                self._look_for_missed(tracks, after_loss=arrival.after_loss)
                novelty = self._merging.take(tracks)
                corrects = novelty is Novelty.CORRECTION
                self._counts["repeated"] += novelty is Novelty.REPEATED
                self._counts["corrected"] += corrects
                if novelty is Novelty.NEW or (corrects and self._corrections):
                    self._counts["delivered"] += 1
                    recovered = self._is_recovered(tracks, arrival.monotonic_ns)
                    return Received(tracks, arrival.monotonic_ns, corrects, arrival.traceparent, recovered)

    def _is_recovered(self, tracks: Tracks, arrived_ns: int) -> bool:
        if tracks.delivery is None:
            return False
        published_ns = tracks.delivery.published_ns
        took_ns = arrived_ns - published_ns  # two clocks: only differences are meaningful
        if published_ns < self._began_ns:
            return True
        fastest_ns = min(took_ns, self._fastest_ns.get(tracks.stream, took_ns))
        return took_ns - remember(self._fastest_ns, tracks.stream, fastest_ns) > RECOVERED_NS

    @property
    def missed(self) -> tuple[Missed, ...]:
        """Frames whose tracks were lost on the way, the newest 1,024 ranges of them."""
        return tuple(self._missed)

    def _look_for_missed(self, tracks: Tracks, *, after_loss: bool) -> None:
        sensor = tracks.stream, tracks.sensor
        known = self._newest.get(sensor)
        if known is not None and known[0] == tracks.epoch and known[1] >= tracks.seq:
            return
        remember(self._newest, sensor, (tracks.epoch, tracks.seq, tracks.stamp_ns))
        if known is None or not after_loss:
            return
        epoch, seq, stamp_ns = known
        ranges: list[tuple[bytes, int, int | None]] = [(epoch, seq + 1, tracks.seq - 1)]
        if epoch != tracks.epoch:
            ranges = [(epoch, seq + 1, None), (tracks.epoch, 0, tracks.seq - 1)]
        for run, first, last in ranges:
            if last is None or first <= last:
                self._missed.append(Missed(*sensor, run, first, last, stamp_ns, tracks.stamp_ns))
                self._counts["missed"] += 1
