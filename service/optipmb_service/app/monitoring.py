"""Serves health, metrics and the live page over HTTP, where the settings ask for it."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

import structlog

if TYPE_CHECKING:
    from collections.abc import Iterator

    from optipmb_service.http import Source, Watched
    from optipmb_service.settings import Settings

    class Monitored(Source, Watched, Protocol):
        """What is served over HTTP."""


log = structlog.get_logger("optipmb_service")


@contextmanager
def monitoring(settings: Settings, source: Monitored) -> Iterator[None]:
    """Answer over HTTP, where that is asked for.

    Raises:
        HttpError: the address cannot be listened on.
    """
    if not settings.http:
        yield
        return
    from optipmb_service.http import Server, application, page  # noqa: PLC0415 - a third of a second that only this needs

    server = Server(application(source, page(source)), settings.http)
    log.info("http", address=server.address)
    try:
        yield
    finally:
        server.close()
