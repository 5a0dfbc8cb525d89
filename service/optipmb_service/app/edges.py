"""The edges beside Zenoh, where the settings ask for them: HTTP for people and monitoring, and gRPC."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol

import structlog
from optipmb_schemas.installation import install_command

from optipmb_service.runtime.ports import EdgeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from optipmb_service.grpc.server import AddFigures
    from optipmb_service.http import Source, Watched
    from optipmb_service.settings.model import Settings
    from optipmb_service.zenoh.client import Client

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
    from optipmb_service.http import KnownHosts, Server, application, page  # noqa: PLC0415 - a third of a second that only this needs

    server = Server(KnownHosts(application(source, page(source)), settings.http_hosts), settings.http)
    log.info("http", address=server.address)
    try:
        yield
    finally:
        server.close()


@contextmanager
def grpc_edge(settings: Settings, client: Callable[[], Client], add: AddFigures) -> Iterator[None]:
    """Serve gRPC, where that is asked for.

    Args:
        settings: address and certificates.
        client: gives what it uses of the network.
        add: has its figures read with the metrics.

    Raises:
        EdgeError: it cannot be served.
    """
    if not settings.grpc:
        yield
        return
    try:
        from optipmb_service.grpc.server import serving  # noqa: PLC0415 - an extra that only this needs
    except ModuleNotFoundError as error:
        raise EdgeError(f"gRPC needs {error.name}, which is not installed: {install_command('grpc')}") from error
    with serving(settings, client(), add):
        yield
