"""The HTTP application: three questions that orchestrators and Prometheus ask, and room for more routes.

It knows nothing of the service but what `Source` says, so a test runs it with a source of its own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from starlette.applications import Starlette
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from optipmb_service.observability.metrics import CONTENT_TYPE

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    import optipmb_schemas as schemas
    from starlette.requests import Request
    from starlette.routing import BaseRoute

UNAVAILABLE: Final = 503

PROBES: Final = frozenset({"/healthz", "/readyz"})
"""Paths that are answered however many other requests are."""

MONITORING: Final = PROBES | {"/metrics"}
"""Paths that programs ask for, by whatever name the service has for them."""


class Source(Protocol):
    """What the application tells of; every method may be called by any thread and answers at once."""

    def alive(self) -> bool:
        """Tell whether the control loop turns, and the tracking thread is not stuck."""

    def beat_age_s(self) -> float:
        """Return the seconds since the control loop last turned."""

    def ready(self) -> bool:
        """Tell whether the service can be used."""

    def state(self) -> str:
        """Return the state of the process."""

    def failure(self) -> str:
        """Return why the state is degraded; empty while it is not."""

    def status(self) -> schemas.ServiceStatus | None:
        """Return the service's own report; None while it starts."""

    def text(self) -> bytes:
        """Return the metrics in Prometheus' text format."""


def application(source: Source, routes: Sequence[BaseRoute] = ()) -> Starlette:
    """Return the application.

    Args:
        source: what it tells of.
        routes: served besides its own; its own come first.
    """
    own = [
        Route("/healthz", _answer_at_once(lambda: _health(source))),
        Route("/readyz", _answer_at_once(lambda: _readiness(source))),
        Route("/metrics", _answer(lambda: Response(source.text(), media_type=CONTENT_TYPE))),
    ]
    return Starlette(routes=[*own, *routes])


def _health(source: Source) -> Response:
    alive = source.alive()
    body = {"alive": alive, "beat_age_s": round(source.beat_age_s(), 3)}
    return JSONResponse(body, status_code=200 if alive else UNAVAILABLE)


def _readiness(source: Source) -> Response:
    ready = source.ready()
    body: dict[str, object] = {"ready": ready, "state": source.state()}
    if failure := source.failure():
        body["failure"] = failure
    return JSONResponse(body, status_code=200 if ready else UNAVAILABLE)


def _answer_at_once(make: Callable[[], Response]) -> Callable[[Request], Awaitable[Response]]:
    answer = _answer(make)

    # A coroutine: probes wait for no thread.
    async def endpoint(request: Request) -> Response:
        return answer(request)

    return endpoint


def _answer(make: Callable[[], Response]) -> Callable[[Request], Response]:
    # No coroutine: Starlette runs it on a thread, so that making the metrics of many streams delays no other answer.
    def endpoint(_request: Request) -> Response:
        response = make()
        response.headers["cache-control"] = "no-store"
        return response

    return endpoint
