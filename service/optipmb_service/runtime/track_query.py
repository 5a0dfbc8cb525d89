"""Answers `q/tracks`: looks for what is kept and replies with it, on a thread that neither tracks nor sorts queries."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Final

import optipmb_schemas as schemas
import structlog

from optipmb_service.runtime.kept_tracks import TracksRange
from optipmb_service.runtime.ports import TransportError
from optipmb_service.session.problems import problem_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_service.runtime.kept_tracks import KeptTracks
    from optipmb_service.runtime.ports import Request

log = structlog.get_logger("optipmb_service")

AT_ONCE: Final = 16
"""Queries that are answered at once; further ones are refused."""


class TrackQuery:
    """Answers queries for tracks of a range of stamps.

    Args:
        kept: where tracks are kept; each is asked where those before it know nothing of the stream.
        instance: name of the service.
        limits: of messages.
    """

    def __init__(self, kept: Sequence[KeptTracks], instance: str, limits: schemas.Limits) -> None:
        self._kept = kept
        self._instance = instance
        self._limits = limits
        self._pool = ThreadPoolExecutor(1, "tracks")
        self._room = threading.BoundedSemaphore(AT_ONCE)

    def answer(self, request: Request, stream: str) -> None:
        """Take a query; it is finished later."""
        try:
            asked = self._asked(request)
        except schemas.MessageError as error:
            self._refuse(request, stream, error)
            return
        if not self._room.acquire(blocking=False):
            many = schemas.MessageError("too_large", "key", f"at most {AT_ONCE} such queries at a time", "more")
            self._refuse(request, stream, many)
            return
        wanted = TracksRange(asked.from_ns, asked.to_ns)
        self._pool.submit(self._find, request, stream, asked, wanted, self._kept)

    def _find(
        self,
        request: Request,
        stream: str,
        asked: schemas.TracksRequest,
        wanted: TracksRange,
        kept: Sequence[KeptTracks],
    ) -> None:
        def found(failure: str) -> None:
            if failure or wanted.known or not kept[1:]:
                self._pool.submit(self._reply, request, stream, asked, wanted, failure)
            else:
                self._pool.submit(self._find, request, stream, asked, wanted, kept[1:])

        try:
            kept[0].find(stream, wanted, found)
        except Exception as error:
            log.exception("internal_error", stream=stream)
            found(f"{type(error).__name__}: {error}")

    def _asked(self, request: Request) -> schemas.TracksRequest:
        """Return what a query asks for.

        Raises:
            MessageError: it is no such query.
        """
        if not request.payload:
            return schemas.TracksRequest()
        asked = schemas.decode(request.payload, schemas.TracksRequest, encoding=request.encoding, limits=self._limits)
        if asked.to_ns is not None and asked.to_ns < asked.from_ns:
            raise schemas.MessageError("invalid_value", "to_ns", "`from_ns` or later", str(asked.to_ns))
        return asked

    def _refuse(self, request: Request, stream: str, error: schemas.MessageError) -> None:
        self._finish(request, self._problem(error.code, stream, error.path, error.expected, error.received))

    def _reply(
        self, request: Request, stream: str, asked: schemas.TracksRequest, wanted: TracksRange, failure: str
    ) -> None:
        self._room.release()
        last = None
        try:
            for one in () if failure else wanted.messages():
                request.answer_text(request.key, one.payload, one.encoding)
            if not failure and wanted.cut_ns is None:
                request.answer(request.key, asked)
        except TransportError as error:
            log.warning("reply_failed", key=request.key, error=str(error))
        if failure:
            last = self._problem("unlogged", stream, "", "a log that can be read", failure)
        elif wanted.cut_ns is not None:
            received = f"more, from the stamp {wanted.cut_ns} on"
            last = self._problem("cut", stream, "", "as many tracks as one answer takes", received, wanted.cut_ns)
        self._finish(request, last)

    def _finish(self, request: Request, problem: schemas.Problem | None) -> None:
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
        return problem_of(
            code,
            stream=stream,
            instance=self._instance,
            path=path,
            expected=expected,
            received=received,
            message=f"Query: {path or 'tracks'}: expected {expected}, received {received}.",
            stamp_ns=stamp_ns,
        )
