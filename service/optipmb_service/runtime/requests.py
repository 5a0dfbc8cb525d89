"""What all answers to queries have in common: each is finished whatever happens, and an error is a `Problem`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import structlog

from optipmb_service.runtime.ports import TransportError
from optipmb_service.session.problems import problem_of

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Future

    import optipmb_schemas as schemas

    from optipmb_service.runtime.ports import Request

log = structlog.get_logger("optipmb_service")


def guarded(request: Request, answer: Callable[[], Future[None] | None]) -> None:
    """Answer, and finish the request whatever happens: an asker must not wait for its timeout.

    Args:
        request: what is asked.
        answer: answers it, or returns what will do so, and finish it, on another thread.
    """
    began_ns, later = time.monotonic_ns(), None
    try:
        later = answer()
    except TransportError as error:
        log.warning("reply_failed", key=request.key, error=str(error))
    finally:
        if later is None:
            request.finish()
        log.debug("query", key=request.key, took_ms=(time.monotonic_ns() - began_ns) / 1e6)


def problem_with(error: schemas.MessageError, *, instance: str, stream: str = "", code: str = "") -> schemas.Problem:
    """Return what is answered to a query that is refused, by default with the code of its error."""
    return problem_of(
        code or error.code,
        stream=stream,
        instance=instance,
        path=error.path,
        expected=error.expected,
        received=error.received,
        message=f"Query: {error.path or 'payload'}: expected {error.expected}, received {error.received}.",
    )
