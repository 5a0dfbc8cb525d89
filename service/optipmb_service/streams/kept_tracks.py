"""Answers to `q/tracks`: tracks of a range of stamps, from the log or from publishers' caches.

Messages are given as they were published. Of a frame that was published several times the tracks that hold are given.
"""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ConnectionFailed as TransportError

from optipmb_service.session.problems import problem_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from optipmb_client.zenoh.handles import Query

    from optipmb_service.cluster.message_log import LogMessage
    from optipmb_service.streams.recovery import Log

log = structlog.get_logger("optipmb_service")

AT_ONCE: Final = 16
"""Queries that are answered at once; further ones are refused."""

MOST: Final = 256
"""Frames of an answer, unless more have one stamp."""

MOST_BYTES: Final = 2**22
"""Bytes of an answer, but for its first stamp."""

LATE_NS: Final = 5_000_000_000
"""Longest distance, by stamps, of a correction from the tracks of a frame. Frames are inserted for a second."""


class _Recent(NamedTuple):
    epoch: bytes
    seq: int
    sensor: str
    stamp_ns: int
    order: tuple[int, int]
    payload: bytes
    encoding: str


_Published: TypeAlias = "LogMessage | _Recent"
"""Tracks as they were published; the higher `order` of a frame holds."""


class TracksRange:
    """Tracks with stamps from one to another, as many as an answer takes.

    Args:
        from_ns: first stamp.
        to_ns: last stamp; None: up to the newest.
        most: frames that it takes.
        most_bytes: bytes that it takes.
    """

    def __init__(self, from_ns: int, to_ns: int | None, most: int = MOST, most_bytes: int = MOST_BYTES) -> None:
        self.from_ns = from_ns
        self.known = False
        """Whether anything is kept of the stream, in the range or not."""
        self.cut_ns: int | None = None
        """The stamp from which on there is more; None: this is all."""
        self._to_ns = to_ns
        self._most = most
        self._most_bytes = most_bytes
        self._frames: dict[tuple[bytes, int, str], _Published] = {}

    def add(self, messages: Iterable[_Published]) -> bool:
        """Take messages in the order of their publication; False: no later one belongs here."""
        latest_ns = 0
        for one in messages:
            self.known = True
            latest_ns = max(latest_ns, one.stamp_ns)
            if one.stamp_ns < self.from_ns or (self._to_ns is not None and one.stamp_ns > self._to_ns):
                continue
            frame = one.epoch, one.seq, one.sensor
            known = self._frames.get(frame)
            if known is None or one.order >= known.order:
                self._frames[frame] = one
        self._cut()
        return self._to_ns is None or latest_ns <= self._to_ns + LATE_NS

    def messages(self) -> list[_Published]:
        return sorted(self._frames.values(), key=lambda one: (one.stamp_ns, one.sensor, one.seq))

    def _cut(self) -> None:
        """Leave out what an answer does not take: from a stamp on everything."""
        size = 0
        ordered = self.messages()
        for count, one in enumerate(ordered):
            size += len(one.payload)
            if (count >= self._most or size > self._most_bytes) and one.stamp_ns > ordered[0].stamp_ns:
                self.cut_ns = one.stamp_ns
                self._to_ns = one.stamp_ns - 1
                self._frames = {frame: kept for frame, kept in self._frames.items() if kept.stamp_ns < one.stamp_ns}
                return


def order_of(tracks: schemas.Tracks) -> tuple[int, int]:
    """Return the order among the tracks of one frame: the highest hold."""
    return tracks.delivery.run if tracks.delivery else 0, tracks.revision


class TrackQuery:
    """Answers queries for tracks, on a thread that neither tracks nor sorts queries.

    Args:
        logged: the log, if there is one.
        recent: returns what caches hold for a stream, each message with its encoding; asked where the log has nothing.
        instance: name of the service.
        limits: of messages.
    """

    def __init__(
        self,
        logged: Log | None,
        recent: Callable[[str], Sequence[tuple[bytes, str]]],
        instance: str,
        limits: schemas.Limits,
    ) -> None:
        self._logged = logged
        self._recent = recent
        self._instance = instance
        self._limits = limits
        self._pool = ThreadPoolExecutor(1, "tracks")
        self._room = threading.BoundedSemaphore(AT_ONCE)

    def answer(self, request: Query, stream: str) -> None:
        """Take a query; it is finished later."""
        try:
            asked = self._asked(request)
        except schemas.MessageError as error:
            self._finish(request, self._problem(error.code, stream, error.path, error.expected, error.received))
            return
        wanted = TracksRange(asked.from_ns, asked.to_ns)

        def answer(failure: str) -> None:
            self._pool.submit(self._answer, request, stream, asked, wanted, failure)

        if self._logged is None:
            answer("")
        else:
            from_ns = max(0, wanted.from_ns - LATE_NS)
            self._pool.submit(self._guarded, stream, answer, self._logged.tracks, stream, from_ns, wanted.add, answer)

    def _asked(self, request: Query) -> schemas.TracksRequest:
        """Return what a query asks for, and take the room for its answer."""
        asked, payload = schemas.TracksRequest(), request.payload
        if payload:
            asked = schemas.decode(payload, schemas.TracksRequest, encoding=request.encoding, limits=self._limits)
        if asked.to_ns is not None and asked.to_ns < asked.from_ns:
            raise schemas.MessageError("invalid_value", "to_ns", "`from_ns` or later", str(asked.to_ns))
        if not self._room.acquire(blocking=False):
            raise schemas.MessageError("too_large", "key", f"at most {AT_ONCE} such queries at a time", "more")
        return asked

    @staticmethod
    def _guarded(stream: str, failed: Callable[[str], object], work: Callable[..., None], *arguments: object) -> None:
        try:
            work(*arguments)
        except Exception as error:
            log.exception("internal_error", stream=stream)
            failed(f"{type(error).__name__}: {error}")

    def _answer(
        self, request: Query, stream: str, asked: schemas.TracksRequest, wanted: TracksRange, failure: str
    ) -> None:
        """Answer with what the log has, or caches where it knows nothing of the stream."""
        failures = [failure] if failure else []
        if not (failure or wanted.known):
            self._guarded(stream, failures.append, self._add_recent, stream, wanted, failures)
        self._room.release()
        failure, last = "".join(failures), None
        try:
            for one in () if failure else wanted.messages():
                request.answer_text(request.key, one.payload, one.encoding)
            if not failure and wanted.cut_ns is None:
                request.answer(request.key, asked)
        except TransportError as error:
            log.warning("reply_failed", key=request.key, error=str(error))
        if failure:
            last = self._problem("message_log", stream, "", "a message log that can be read", failure)
        elif wanted.cut_ns is not None:
            received = f"more, from the stamp {wanted.cut_ns} on"
            last = self._problem("cut", stream, "", "as many tracks as one answer takes", received, wanted.cut_ns)
        self._finish(request, last)

    def _add_recent(self, stream: str, wanted: TracksRange, failures: list[str]) -> None:
        try:
            found = [self._read(*one) for one in self._recent(stream)]
        except TransportError as error:
            failures.append(str(error))
        else:
            wanted.add(one for one in found if one is not None)

    def _read(self, payload: bytes, encoding: str) -> _Recent | None:
        try:
            tracks = schemas.decode(payload, schemas.Tracks, encoding=encoding, limits=self._limits)
        except schemas.MessageError:  # of somebody else
            return None
        frame = tracks.epoch, tracks.seq, tracks.sensor or "", tracks.stamp_ns
        return _Recent(*frame, order_of(tracks), payload, encoding)

    def _finish(self, request: Query, problem: schemas.Problem | None) -> None:
        try:
            if problem is not None:
                request.refuse(problem)
        except TransportError as error:
            log.warning("reply_failed", key=request.key, error=str(error))
        finally:
            request.finish()

    def _problem(
        self, code: str, stream: str, path: str, expected: str, received: str, stamp_ns: int | None = None
    ) -> schemas.Problem:
        texts = {"path": path, "expected": expected, "received": received, "subject": "Query"}
        return problem_of(code, stream=stream, instance=self._instance, stamp_ns=stamp_ns, **texts)
