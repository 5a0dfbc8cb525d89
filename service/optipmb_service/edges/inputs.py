"""Frames of senders that have no publisher of their own: numbers, repetitions, and the way to the network.

The service tracks a frame once by its epoch and number. The edge numbers frames that have none, with one epoch for each
stream and process. It recognises repeated frames by their key or stamp. After a restart of the edge, the services'
caches say which stamps were tracked: a new epoch that repeats one would restart the session.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import hashlib
import secrets
import time
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakValueDictionary

import msgspec
import optipmb_schemas as schemas
from optipmb_client.errors import ConnectionFailed as TransportError
from optipmb_client.incoming import Answer
from optipmb_client.trace_context import attachment_of
from optipmb_schemas.errors import show

from optipmb_service.edges.json_frames import STEP_NS, separate
from optipmb_service.telemetry.problem_reporter import ProblemReporter
from optipmb_service.units import SECOND
from optipmb_service.zenoh.client import IdlePool, TooManyStreamsError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from optipmb_client.zenoh.session import Sample

    from optipmb_service.edges.json_frames import JsonFrame
    from optipmb_service.settings import InputSettings, Settings
    from optipmb_service.zenoh.client import Client, Outgoing

CACHE: Final = 400
"""Detections that a publisher keeps for recovery: 20 s of a sensor at 20 Hz."""

INLINE_BYTES: Final = 64 * 2**10
"""Larger frames are read, and handed to the network, on a thread: that takes a while, and may wait for the link."""

WINDOW: Final = 64
"""Frames of a stream that may be without tracks."""

STALL_S: Final = 1.0
"""Frames that are without tracks when nothing has come for so long were refused, or are not tracked."""

STREAMS: Final = 10_000
"""Streams whose epochs are kept; then the least recently used one goes."""

FRAMES: Final = 1024
"""Frames of a stream that are known when they come again."""

ALL_FRAMES: Final = 2**20
"""The same of all streams."""

IDLE_PUBLISHERS: Final = 1000

FLUSH_S: Final = 1.0
"""Period of summaries of problems."""

OFFSETS: Final = 100
"""Frames by which the offset of a sender's clock is known."""

NEW_CLOCK: Final = 3
"""Least number of frames whose offset is that of a new clock."""

PACE: Final = 0.25
"""Largest difference of their intervals of arrival from those of their stamps, as a share."""

OTHER_CONTENT: Final = 'a key or stamp of its own: finer stamps, `epoch` and `seq`, or `clock = "arrival"` in `inputs`'
LATER: Final = frozenset({"busy", "too_many_streams", "unlinked"})
"""Why a frame may be sent again."""


class RefusedError(Exception):
    """A frame that is valid, and was not sent.

    Attributes:
        code: for programs: `late`, `duplicate_epoch`, `duplicate_key`, `busy`, `too_many_streams`, `unlinked`,
            `not_allowed`.
        expected, received: why.
        retry_s: when it may come again; 0: never.
    """

    def __init__(self, code: str, expected: str, received: str, retry_s: float = 0.0) -> None:
        super().__init__(f"expected {expected}, received {received} [{code}]")
        self.code = code
        self.expected = expected
        self.received = received
        self.retry_s = retry_s


class Sent(NamedTuple):
    """Numbers and stamp with which a frame was sent."""

    epoch: bytes
    seq: int
    stamp_ns: int


class _Mark(NamedTuple):
    """Key by which a frame is recognised, and its content.

    Attributes:
        key: digest of the key.
        name: of the key, for people.
        content: digest of the content.
        size: bytes of the content.
    """

    key: bytes
    name: str
    content: bytes
    size: int


class _Known(NamedTuple):
    """A frame that was sent, and its content as in `_Mark`."""

    sent: Sent
    content: bytes
    size: int


class _Head(msgspec.Struct):
    """What an edge reads of tracks."""

    stream: str
    epoch: bytes
    seq: int
    stamp_ns: int
    sensor: str | None = None


class _Problem(msgspec.Struct):
    """What an edge reads of problems."""

    code: str
    received: str = ""


_head: Final = msgspec.msgpack.Decoder(_Head)
_problem: Final = msgspec.msgpack.Decoder(_Problem)


class InFlight:
    """Frames of a sender that are without tracks; their number bounds its speed. To be used on the loop."""

    def __init__(self) -> None:
        self._frames: collections.OrderedDict[tuple[bytes, int], None] = collections.OrderedDict()
        self._progress = time.monotonic()
        self._changed = asyncio.Event()

    def add(self, epoch: bytes, seq: int) -> None:
        """Add a frame that goes out."""
        if not self._frames:
            self._progress = time.monotonic()
        self._frames[epoch, seq] = None

    def remove(self, epoch: bytes, seq: int) -> None:
        """Remove a frame that has tracks; those sent before it that have none will have none, or have them late."""
        if (epoch, seq) in self._frames:
            while next(iter(self._frames)) != (epoch, seq):
                self._frames.popitem(last=False)
            del self._frames[epoch, seq]
            self._progress = time.monotonic()
            self._changed.set()

    def full(self) -> bool:
        """Return whether `WINDOW` frames are without tracks; when that stalls, forget them."""
        if len(self._frames) >= WINDOW and time.monotonic() - self._progress >= STALL_S:
            self._frames.clear()
        return len(self._frames) >= WINDOW

    async def below(self, most: int) -> None:
        """Wait until less than so many frames are without tracks; when that stalls, forget them."""
        while len(self._frames) >= most:
            self._changed.clear()
            try:
                async with asyncio.timeout(self._progress + STALL_S - time.monotonic()):
                    await self._changed.wait()
            except TimeoutError:
                self._frames.clear()


async def put(publish: Callable[[bytes, bytes | None], object], payload: bytes, traceparent: str) -> None:
    """Hand a message to the network with its trace context, which is unchecked.

    Raises:
        TransportError: the network cannot be used.
    """
    attachment = attachment_of(traceparent)
    if len(payload) <= INLINE_BYTES:
        publish(payload, attachment)
    else:
        await asyncio.to_thread(publish, payload, attachment)


class _Clock:
    """Stamps of frames that do not keep the sender's. Created for each stream."""

    def __init__(self) -> None:
        self._offsets: collections.deque[int] = collections.deque(maxlen=OFFSETS)
        self._others: collections.deque[tuple[int, int]] = collections.deque(maxlen=OFFSETS)
        """Newest frames of another offset, by the sender and by the arrival."""
        self._sender_ns = self._last_ns = 0

    def arrival(self, arrived_ns: int) -> int:
        """Return the time of arrival, after the one before."""
        self._last_ns = max(arrived_ns, self._last_ns + STEP_NS)
        return self._last_ns

    def moved(self, sender_ns: int, arrived_ns: int) -> tuple[int, int]:
        """Return a sender's stamp on the clock of this machine, by the least offset of the last frames.

        Another offset is that of a new clock when frames with it come at the pace of their stamps: those that were held
        come faster. Until then the old one holds.

        Returns:
            The stamp, and by how much the offset is exceeded, ns; 0 where that may be the way here.
        """
        offset = arrived_ns - sender_ns
        exceeded_ns = offset - min(self._offsets, default=offset)
        if abs(exceeded_ns) <= SECOND:
            self._offsets.append(offset)
            self._others.clear()
        else:
            if self._others and abs(offset - self._others[-1][1] + self._others[-1][0]) > SECOND:
                self._others.clear()
            self._others.append((sender_ns, arrived_ns))
            sent_ns, came_ns = (last - first for first, last in zip(self._others[0], self._others[-1], strict=True))
            if len(self._others) >= NEW_CLOCK and abs(came_ns - sent_ns) <= PACE * sent_ns:
                self._offsets = collections.deque((came - sent for sent, came in self._others), OFFSETS)
                self._others.clear()
        stamp_ns = max(0, sender_ns + min(*self._offsets, offset))  # no frame arrives before it is stamped
        if sender_ns > self._sender_ns:
            stamp_ns = max(stamp_ns, self._last_ns + STEP_NS)
        self._sender_ns, self._last_ns = sender_ns, stamp_ns
        return stamp_ns, exceeded_ns if self._others and exceeded_ns > 0 else 0


@dataclass
class _SenderStream:
    """A stream of the edge: its numbers, the newest frames, and who waits for tracks. To be used on the loop."""

    epoch: bytes = field(default_factory=lambda: secrets.token_bytes(16))
    seq: int = 0
    sent: collections.OrderedDict[bytes, _Known] = field(default_factory=collections.OrderedDict)
    """Newest frames by the keys of their marks."""
    tracked: dict[int, Sent] | None = None
    """Frames in the caches of tracks when the stream was opened, by stamp; None: they were not asked yet."""
    replaced_until: float = 0.0
    """Monotonic time until which another publisher has the stream."""
    clock: _Clock = field(default_factory=_Clock)
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    in_flight: InFlight = field(default_factory=InFlight)
    waiting: WeakValueDictionary[tuple[bytes, int], asyncio.Future[Answer]] = field(default_factory=WeakValueDictionary)
    """Tracks that somebody waits for, by the numbers of their frames."""
    users: int = 0
    link: _Link | None = None


class _Link(NamedTuple):
    """Publisher of a stream; with its subscriptions to close."""

    outgoing: Outgoing
    opened: contextlib.ExitStack

    def close(self) -> None:
        self.opened.close()


class Inputs:
    """Streams of senders without publishers. Create and use it on one loop.

    Attributes:
        frames, duplicates: frames that were sent, and that came again, by edge.
        refused: frames that were not valid or not sent, by edge and code.

    Args:
        settings: of the process.
        client: on the network.
        edge: its name in the metrics.
        sessions: returns the session that a stream feeds.
    """

    def __init__(self, settings: Settings, client: Client, edge: str, sessions: Callable[[str], str]) -> None:
        self.client = client
        self.frames: collections.Counter[str] = collections.Counter()
        self.duplicates: collections.Counter[str] = collections.Counter()
        self.refused: collections.Counter[tuple[str, str]] = collections.Counter()
        self._edge = edge
        self._instance = settings.instance
        self._gap_s = settings.gap_limit_s
        self._session_of = sessions
        self._loop = asyncio.get_running_loop()
        self._streams: collections.OrderedDict[str, _SenderStream] = collections.OrderedDict()
        self._remembered = 0
        self._idle: IdlePool[_Link] = IdlePool(IDLE_PUBLISHERS)
        self._reporter = ProblemReporter(client.publish_problem)
        self._flushing = False

    def report(self, stream: str, error: schemas.MessageError | RefusedError) -> None:
        """Count a refused frame, and report it, on its stream if it has one, unless the frame may be sent again."""
        self.refused[self._edge, error.code] += 1
        if isinstance(error, schemas.MessageError):
            self._report(stream, error.code, error)
        elif error.code not in LATER:
            about = schemas.MessageError("invalid_value", "", error.expected, error.received)
            self._report(stream, error.code, about)

    def _report(self, stream: str, code: str, error: schemas.MessageError) -> None:
        problem = schemas.Problem.of(error, stream=stream, instance=self._instance)
        message = problem.message.replace(f"[{error.code}]", f"[{code}]")
        self._reporter.report(problem.model_copy(update={"code": code, "message": message}), time.monotonic_ns())
        if not self._flushing:
            self._flush_later()

    async def send(
        self, frame: JsonFrame, rules: InputSettings, repeats: str = "", traceparent: str = "", wait_s: float = 0.0
    ) -> tuple[Sent, bool, Answer | None]:
        """Hand a frame to the network, unless it was sent before.

        Args:
            frame: the frame.
            rules: settings of its stream.
            repeats: name of the key by which it is recognised if it has none of its own.
            traceparent: W3C trace context, unchecked.
            wait_s: how long to wait for its tracks.

        Returns:
            Its numbers, whether it was sent before, and its tracks if they came in time.

        Raises:
            RefusedError: it is not sent now.
        """
        name = frame.message.stream
        async with self._used(name) as stream:
            async with stream.lock:  # taken once: frames of a stream go out in the order in which they came
                await self._prepare(name, stream)
                parts = [frame] if rules.is_complete else separate(frame)
                before: Sent | None = None
                for at, one in enumerate(parts):
                    if at and before is None:  # the frame has begun: sent again, its objects would be sent twice
                        await stream.in_flight.below(WINDOW)
                    mark = None if one.is_numbered else _mark(one, repeats, at, rules)
                    before = None if one.is_numbered else self._before(stream, one, mark, rules)
                    sent = before or self._numbered(stream, one, rules)
                    tracks = stream.waiting.setdefault(sent[:2], self._loop.create_future())
                    if before is None:
                        await self._put(stream, one, sent, traceparent)
                        self._remember(stream, mark, sent)
            counts = self.frames if before is None else self.duplicates
            counts[self._edge] += 1
            return sent, before is not None, await self._tracks(name, sent, tracks, wait_s, is_new=before is None)

    @contextlib.asynccontextmanager
    async def _used(self, name: str) -> AsyncIterator[_SenderStream]:
        """Give a stream; the last user leaves its publisher to the next one.

        Raises:
            RefusedError: the network cannot be used meanwhile.
        """
        stream = self._streams.get(name) or _SenderStream()
        self._streams[name] = stream
        self._streams.move_to_end(name)
        stream.users += 1
        try:
            yield stream
        except TooManyStreamsError as error:
            raise RefusedError("too_many_streams", "fewer new streams", "more", error.wait_s) from error
        except TransportError as error:
            raise RefusedError("unlinked", "a network", str(error)) from error
        finally:
            stream.users -= 1
            if not stream.users and stream.link is not None:
                self._idle.keep(name, stream.link)
                stream.link = None
            self._forget()

    async def _prepare(self, name: str, stream: _SenderStream) -> None:
        """Open the publisher of a stream, and ask once for its tracked frames.

        Raises:
            TransportError: the network cannot be used, or too many streams were opened.
        """
        if not self.client.linked():
            raise TransportError("no link to a router")
        if stream.link is None:
            stream.link = self._idle.take(name) or await asyncio.to_thread(self._open, name)
        if stream.tracked is None:
            found = [one for one, _ in await asyncio.to_thread(self._cached, name)]
            stream.tracked = {one.stamp_ns: Sent(one.epoch, one.seq, one.stamp_ns) for one in found}

    def _before(self, stream: _SenderStream, frame: JsonFrame, mark: _Mark | None, rules: InputSettings) -> Sent | None:
        """Return with which numbers a frame was sent; None of a new one.

        Raises:
            RefusedError: other content was sent with its key, or it is earlier than a frame that was tracked before
                this edge began.
        """
        stamp_ns, tracked = frame.message.stamp_ns, stream.tracked or {}
        if mark is not None and (known := stream.sent.get(mark.key)) is not None:
            if known.content != mark.content:
                expected = f"the {known.size} bytes that were sent with {mark.name}; other content with {OTHER_CONTENT}"
                raise RefusedError("duplicate_key", expected, f"{mark.size} bytes of other content")
            return known.sent
        if not frame.is_stamped or rules.clock != "sender":
            return None
        if (sent := tracked.get(stamp_ns)) is not None:
            return sent
        if tracked and not stream.seq and stamp_ns < max(tracked):
            expected = f"a stamp after {max(tracked)}, which was tracked before this edge began; or epoch and seq"
            raise RefusedError("late", expected, str(stamp_ns))
        return None

    def _numbered(self, stream: _SenderStream, frame: JsonFrame, rules: InputSettings) -> Sent:
        """Return the numbers of a new frame.

        Raises:
            RefusedError: it is not sent now.
        """
        message = frame.message
        if stream.in_flight.full():
            raise RefusedError("busy", f"less than {WINDOW} frames without tracks", f"{WINDOW} of the stream", 1.0)
        if not frame.is_numbered and (left_s := stream.replaced_until - time.monotonic()) > 0:
            raise RefusedError("duplicate_epoch", "one publisher of the stream", "another one that sends", left_s)
        if not frame.is_stamped or rules.clock == "arrival":
            stamp_ns = stream.clock.arrival(frame.arrived_ns)
        elif rules.clock == "sender":
            stamp_ns = message.stamp_ns
        else:
            stamp_ns, exceeded_ns = stream.clock.moved(message.stamp_ns, frame.arrived_ns)
            if exceeded_ns:
                expected = "at most 1 s more than before from the stamp to the arrival; the offset of the clock stays"
                late = schemas.MessageError("invalid_value", "stamp_ns", expected, f"{exceeded_ns / SECOND:.3f} s more")
                self._report(message.stream, "clock", late)
        if frame.is_numbered:
            return Sent(message.epoch, message.seq, stamp_ns)
        return Sent(stream.epoch, stream.seq, stamp_ns)

    async def _put(self, stream: _SenderStream, frame: JsonFrame, sent: Sent, traceparent: str) -> None:
        assert stream.link is not None  # noqa: S101 - in use: said for the type checker
        await put(stream.link.outgoing.detections, schemas.encode(frame.message, **sent._asdict()), traceparent)
        stream.in_flight.add(sent.epoch, sent.seq)
        stream.seq += not frame.is_numbered

    def _remember(self, stream: _SenderStream, mark: _Mark | None, sent: Sent) -> None:
        if mark is not None:
            self._remembered += 1
            stream.sent[mark.key] = _Known(sent, mark.content, mark.size)
            if len(stream.sent) > FRAMES:
                stream.sent.popitem(last=False)
                self._remembered -= 1

    def _forget(self) -> None:
        """Forget the least recently used streams beyond the bounds."""
        while len(self._streams) > STREAMS or self._remembered > ALL_FRAMES:
            name = next((name for name, stream in self._streams.items() if not stream.users), None)
            if name is None:
                return
            self._remembered -= len(self._streams.pop(name).sent)

    async def _tracks(
        self, name: str, sent: Sent, tracks: asyncio.Future[Answer], wait_s: float, *, is_new: bool
    ) -> Answer | None:
        """Return the tracks of a frame, from the caches if it was sent before; None if they do not come in time."""
        if wait_s and not is_new:
            for head, answer in reversed(await asyncio.to_thread(self._cached, name)):
                if (head.epoch, head.seq) == sent[:2]:
                    return answer
        if wait_s:
            await asyncio.wait((tracks,), timeout=wait_s)
        return tracks.result() if tracks.done() else None

    def _open(self, name: str) -> _Link:
        """Subscribe to the tracks and problems of a stream, and open its publisher."""
        keys = self.client.keys
        with contextlib.ExitStack() as opened:
            for key, take in (
                (keys.tracks(self._session_of(name)), self._take_tracks),
                (keys.problems(name), self._take_problem),
            ):
                opened.callback(self.client.listen(key, partial(take, name)).close)
            outgoing = self.client.publish(name, CACHE, 0, lambda: None)
            opened.callback(outgoing.close)
            return _Link(outgoing, opened.pop_all())

    def _cached(self, name: str) -> list[tuple[_Head, Answer]]:
        """Return the tracks of a stream that the services keep; may wait."""
        answers = self.client.cached(self.client.keys.tracks(self._session_of(name)))
        return [(head, one) for one in answers if (head := _head_of(one.payload, name)) is not None]

    def _take_tracks(self, name: str, sample: Sample) -> None:
        """Take tracks on a thread of the network."""
        payload = sample.payload.to_bytes()
        if (head := _head_of(payload, name)) is not None:
            answer = Answer(str(sample.key_expr), payload, str(sample.encoding), ok=True)
            self._call(self._tracked, name, (head.epoch, head.seq), answer)

    def _take_problem(self, name: str, sample: Sample) -> None:
        with contextlib.suppress(msgspec.DecodeError):
            problem = _problem.decode(sample.payload.to_bytes())
            if problem.code == "duplicate_epoch":
                self._call(self._replaced, name, problem.received)

    def _call(self, function: Callable[..., None], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function, *arguments)

    def _tracked(self, name: str, numbers: tuple[bytes, int], answer: Answer) -> None:
        if (stream := self._streams.get(name)) is not None:
            stream.in_flight.remove(*numbers)
            if (tracks := stream.waiting.get(numbers)) is not None and not tracks.done():
                tracks.set_result(answer)

    def _replaced(self, name: str, epoch: str) -> None:
        if (stream := self._streams.get(name)) is not None and epoch == stream.epoch.hex():
            stream.replaced_until = time.monotonic() + self._gap_s

    def _flush_later(self) -> None:
        self._flushing = True
        self._loop.call_later(FLUSH_S, self._flush)

    def _flush(self) -> None:
        self._flushing = False
        if self._reporter.flush(time.monotonic_ns()):
            self._flush_later()


def _mark(frame: JsonFrame, repeats: str, part: int, rules: InputSettings) -> _Mark | None:
    """Return the mark of a part of a frame; None without key and stamp."""
    name = f"key {frame.key}" if frame.key else repeats
    content = schemas.encode(frame.message)
    key = b"%d %b" % (part, name.encode())
    if not name:
        if not frame.is_stamped:
            return None
        name = f"stamp_ns {frame.message.stamp_ns}"
        # Several objects may be reported with one stamp; and stamps that are not used need not differ.
        key = content if not rules.is_complete or rules.clock == "arrival" else name.encode()
    return _Mark(_digest(key), show(name)[1:-1], _digest(content), len(content))


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=16).digest()


def _head_of(payload: bytes, stream: str) -> _Head | None:
    """Return the head of tracks that belong to a stream's detections."""
    try:
        head = _head.decode(payload)
    except msgspec.DecodeError:
        return None
    return head if (head.sensor or head.stream) == stream else None
