"""Intake: the subscriptions of a member.

They follow from the held partitions and the known streams alone:

- all detections and all clouds, where this member holds all partitions;
- else detections and clouds of each stream of its partitions, and of partitions left just now, for their holder
  then asks for the messages in between (`recent`);
- detections of streams whose publishers have no cache, which nothing else would have when their member
  is killed (`standby`);
- detections of all streams, where it is the discoverer: the member that holds partition 0. Those whose publishers have
  tokens are dropped unread. It alone watches who tracks which stream.

New subscriptions are declared before old ones are withdrawn. A stream that comes here from another member is held until
the others have answered with their recent messages of it; then its session goes on with them. The member that has a
partition asks once for each session, and the end of a process waits, for a moment, until all was asked for.
"""

from __future__ import annotations

import threading
import time
from itertools import islice
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas
import structlog

from optipmb_service.cluster.leases import PARTITIONS, Change, partition_of
from optipmb_service.units import SECOND
from optipmb_service.zenoh.topics import Input

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from optipmb_service.cluster.member import Member
    from optipmb_service.streams.streams import Streams
    from optipmb_service.zenoh.topics import Kind, Packet
    from optipmb_service.zenoh.transport import Transport

log = structlog.get_logger("optipmb_service")

DISCOVERY: Final = 0
"""The partition whose holder is the discoverer."""

EXPIRY_S: Final = 1.0
NEW_STREAMS: Final = 128
"""New streams that are taken in at once, and announced at once, and none while the lease is renewed late.

What those without a cache sent is asked for before the next are taken in.
"""

REST: Final = 2.0
"""Rest after a step, in times of the processor time that it took."""

MOST_REST_S: Final = 0.5

DRAIN_S: Final = 0.5
"""Longest wait for messages under way in this process, before the held ones are given to another member."""

DRAIN_POLL_S: Final = 0.005


def _inputs(streams: Iterable[str]) -> set[Input]:
    """Return all possible subscriptions to these streams, and those to all streams."""
    kinds: tuple[Kind, Kind] = ("detections", "points")
    of_all = {Input("discovery"), Input("detections"), Input("points")}
    return of_all | {Input(kind, stream, cached) for stream in streams for kind in kinds for cached in (False, True)}


class Intake:
    """Subscriptions of the process, on a thread of their own.

    Args:
        streams: take the messages.
        member: knows which partitions are held.
        inputs: the network.
        standby: whether detections that no cache holds are received for a takeover.
        linger_s: how long streams are received whose partition was left, unless its holder has asked before.
    """

    def __init__(self, streams: Streams, member: Member, inputs: Transport, *, standby: bool, linger_s: float) -> None:
        self._streams = streams
        self._member = member
        self._inputs = inputs
        self._standby = standby
        self._linger_ns = round(linger_s * SECOND)
        self._directory = streams.directory
        self._fusion = streams.parts.fusion
        self._keys = streams.parts.keys
        self._subscribed: set[Input] = set()
        self._known: dict[str, bool] = {}
        """The streams whose inputs are in line, each with whether its publisher has a cache."""
        self._aligned: object = None
        """Inputs of the last step other than streams: when they change, all streams are looked at."""
        self._announced: set[str] = set()
        self._watching = False
        """Whether owners are watched."""
        self._lock = threading.Lock()
        self._came: set[int] = set()
        self._left: dict[int, int] = {}
        self._received: set[int] = set()
        self._owed: set[str] = set()
        """Sessions that have left, until their new member has asked for their held messages."""
        self._given = threading.Condition()
        self._wake = threading.Event()
        self._hurry = threading.Event()
        self._expires_ns = 0
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="intake", daemon=True)

    def start(self) -> None:
        """Begin to receive."""
        streams = self._streams
        self._inputs.receive(streams.receive, self._noticed, streams.passed_by, streams.cache_answered)
        self._directory.began_ns = time.monotonic_ns()  # a start may take long before
        self._inputs.watch_streams(self._published, self._discovered)
        self._step()
        self._thread.start()

    def close(self, timeout: float) -> None:
        """Change nothing any more; a step that takes longer (s) is left to itself."""
        self._ending.set()
        self._hurry.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout)

    def changed(self, partition: int, change: Change) -> None:
        """Follow a change of a partition."""
        self._streams.changed(partition, change)
        with self._lock:
            if change is Change.HELD:
                self._came.add(partition)
                self._left.pop(partition, None)
            elif change is Change.LOST:
                self._came.discard(partition)
                self._left[partition] = time.monotonic_ns() + self._linger_ns
        held = self._streams.held({partition})
        with self._given:
            (self._owed.update if change is Change.LOST else self._owed.difference_update)(held)
        self._hurry.set()
        self._wake.set()

    @property
    def standing_by(self) -> int:
        """Streams that are known here and tracked elsewhere."""
        session_of = self._fusion.session_of
        return sum(not self._member.holds(session_of(stream)) for stream in self._directory.streams())

    def hand_over(self, sessions: Iterable[str], give: Callable[[Packet], None]) -> None:
        """Give recent messages of sessions that are tracked elsewhere now, the oldest first."""
        sessions = list(sessions)
        if asked := [session for session in sessions if self._may_have(session)]:
            self._drain(asked)
            for packet in self._streams.recent(asked):
                give(packet)
            with self._given:
                self._owed.difference_update(asked)
                self._given.notify_all()
        # Who asks has subscribed already.
        still = {partition_of(session) for session in self._owed.copy()}
        with self._lock:
            for partition in {partition_of(session) for session in sessions} - still:
                self._left.pop(partition, None)
        self._wake.set()

    def handed_over(self, timeout: float) -> bool:
        """Wait until the next members have asked for the partitions left here; False after `timeout` seconds."""
        with self._given:
            return self._given.wait_for(lambda: not self._owed, timeout)

    # From the network

    def _stream(self, key: str) -> str | None:
        """Return the stream of a token's key; None when it is none that may publish."""
        try:
            stream = self._keys.stream_of(key)
        except schemas.MessageError:
            return None
        return None if self._fusion.is_session(stream) else stream

    def _published(self, key: str, token: str, present: bool) -> None:  # noqa: FBT001 - as the network calls it
        stream = self._stream(key)
        if stream is not None and self._directory.published(stream, token, time.monotonic_ns(), present=present):
            self._wake.set()

    def _discovered(self, key: str, present: bool) -> None:  # noqa: FBT001 - as the network calls it
        now_ns = time.monotonic_ns()
        for stream in self._keys.discovered_streams(key):
            if self._fusion.is_session(stream):
                continue
            if self._directory.discovered(stream, key, now_ns, present=present):
                self._wake.set()

    def _noticed(self, key: str, recoverable: bool) -> bool:  # noqa: FBT001 - as the network calls it
        """Note detections of any stream; False: the publisher has a token, and its member receives them."""
        try:
            stream, _ = self._streams.parsed(key)
        except schemas.MessageError:
            return True  # to be reported
        is_raw = self._directory.noticed(stream, time.monotonic_ns(), recoverable=recoverable)
        if is_raw and stream not in self._known:
            self._streams.expect(self._fusion.session_of(stream))
            if self._directory.announces(stream):
                self._wake.set()
        return is_raw

    # The thread

    def _run(self) -> None:
        while not self._ending.is_set():
            self._wake.wait(EXPIRY_S)
            self._wake.clear()
            self._hurry.clear()
            began_s = time.thread_time()
            try:
                self._step()
            except Exception:
                if self._ending.is_set():
                    return  # the session is closed
                log.exception("internal_error", thread="intake")
            # A step looks at all streams: where thousands begin, one step serves all that came meanwhile.
            self._hurry.wait(min(MOST_REST_S, REST * (time.thread_time() - began_s)))

    def _step(self) -> None:
        """Align the subscriptions with held partitions and known streams; the next step retries failures."""
        now_ns = time.monotonic_ns()
        with self._lock:
            came, self._came = self._came, set()
        held = self._member.partitions  # afterwards: a partition that came is held, or lost again
        with self._lock:
            self._left = {partition: until for partition, until in self._left.items() if until > now_ns}
            received = self._received = held | self._left.keys()
        known = self._known
        try:
            self._align(came, held, received, now_ns)
        except Exception:
            with self._lock:
                self._came |= came & self._member.partitions
            self._known, self._aligned = known, None
            raise

    def _align(self, came: set[int], held: set[int], received: set[int], now_ns: int) -> None:
        """Declare and withdraw subscriptions, and open sessions that came here."""
        everything = len(held) == PARTITIONS
        discovering = DISCOVERY in held
        if now_ns >= self._expires_ns:
            self._directory.expire(now_ns, discovering=discovering)
            self._expires_ns = now_ns + round(EXPIRY_S * SECOND)
        elif discovering:
            self._directory.admit(now_ns)
        self._watch_owners(discovering=discovering)
        if discovering and Input("discovery") not in self._subscribed and not everything:
            self._directory.adopt(now_ns)
        streams = self._directory.streams()
        aligned = (held, received, everything, discovering)
        anew, self._aligned = bool(came) or aligned != self._aligned, aligned
        # Where thousands begin, each step is to look at changed ones.
        looked = streams if anew else dict(streams.items() - self._known.items())
        gone = self._known.keys() - streams.keys()
        strained = self._member.strained
        later = self._later(looked, came, held, everything=everything, strained=strained)
        if later:
            looked = {stream: cached for stream, cached in looked.items() if stream not in later}
        coming = self._coming(looked, came, held)
        for session in coming:
            self._streams.hold(session)
        wanted = self._wanted(looked, received, everything=everything, discovering=discovering)
        before = self._subscribed if anew else self._subscribed & _inputs(looked.keys() | gone)
        for one in sorted(wanted - before):
            self._inputs.subscribe(one.kind, one.stream, cached=one.cached)
            self._subscribed.add(one)
        left = before - wanted
        self._inputs.unsubscribe(sorted(left))
        self._subscribed -= left
        if not everything and any(one.kind == "detections" for one in left):
            self._streams.forget_caches({one.stream for one in self._subscribed if one.kind == "detections"})
        self._announce(self._directory.announced(), strained=strained)
        for stream in later:
            del streams[stream]
        self._known = streams
        if coming:
            self._take_up(coming)

    def _take_up(self, sessions: Sequence[str]) -> None:
        """Go on with sessions that came here, each with what others have received of it lately."""
        packets: dict[str, list[Packet]] = {session: [] for session in sessions}
        try:
            for packet in self._inputs.ask_recent(sessions):
                _, session = self._streams.parsed(packet.key)
                if session in packets:
                    packets[session].append(packet)
        finally:
            for session, found in packets.items():
                self._streams.take_up(session, found)

    def _may_have(self, session: str) -> bool:
        """Whether something of a session that is tracked elsewhere may have come, or be on its way through here."""
        if self._member.holds(session):
            return False
        received = DISCOVERY in self._received or partition_of(session) in self._received
        return received or self._streams.keeps(session)

    def _drain(self, sessions: list[str]) -> None:
        """Wait for messages on their way through this process, for a moment at most."""
        ends = time.monotonic() + DRAIN_S
        passed = threading.Event()
        self._inputs.pass_through(passed.set)
        passed.wait(DRAIN_S)
        while any(self._streams.waits(session) for session in sessions) and time.monotonic() < ends:
            time.sleep(DRAIN_POLL_S)

    def _watch_owners(self, *, discovering: bool) -> None:
        if discovering is not self._watching or (discovering and self._streams.doubts_owners):
            self._inputs.watch_owners(self._streams.on_owner() if discovering else None)
            self._watching = discovering

    def _later(
        self, looked: dict[str, bool], came: set[int], held: set[int], *, everything: bool, strained: bool
    ) -> set[str]:
        """Return the new streams that are to be taken in by a later step."""
        session_of = self._fusion.session_of
        new = [
            stream
            for stream, cached in looked.items()
            if stream not in self._known
            and (partition := partition_of(session_of(stream))) in held
            and not (cached and (everything or partition in came))
        ]
        if len(new) > NEW_STREAMS and not strained:
            self._wake.set()
        return set(new[0 if strained else NEW_STREAMS :])

    def _announce(self, streams: set[str], *, strained: bool) -> None:
        new = streams - self._announced
        announced = (streams & self._announced) | set(islice(new, 0 if strained else NEW_STREAMS))
        self._inputs.discover(announced)
        self._announced = announced
        if len(new) > NEW_STREAMS and not strained:
            self._wake.set()

    def _wanted(
        self, streams: dict[str, bool], received: set[int], *, everything: bool, discovering: bool
    ) -> set[Input]:
        if everything:
            return {Input("detections"), Input("points")}
        wanted = {Input("discovery")} if discovering else set()
        for stream, cached in streams.items():
            own = partition_of(self._fusion.session_of(stream)) in received
            if own:
                wanted.add(Input("points", stream, cached))
            # The discoverer's subscription to all includes streams without a cache.
            if (own and cached) or (not cached and not discovering and (own or self._standby)):
                wanted.add(Input("detections", stream, cached))
        return wanted

    def _coming(self, streams: dict[str, bool], came: set[int], held: set[int]) -> list[str]:
        """Return the sessions of which others may have messages: newly held ones, and new streams."""
        session_of = self._fusion.session_of
        coming = {session_of(stream) for stream in streams if came and partition_of(session_of(stream)) in came}
        coming |= {
            session
            for stream, cached in streams.items()
            if not cached and stream not in self._known and not self._directory.announces(stream)
            and partition_of(session := session_of(stream)) in held
            and self._streams.of(session) is None
        }  # fmt: skip
        return sorted(coming | self._streams.held(came) if came else coming)
