"""The two ways to a tracking service: Zenoh, which is the native one, and gRPC, by the endpoints that are given."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from optipmb_schemas.installation import install_command

from optipmb_client.errors import ClientError, ConnectionFailed
from optipmb_client.zenoh import Connection

if TYPE_CHECKING:
    from optipmb_client.grpc import GrpcConnection

__all__ = ["GRPC", "Link", "linked"]

GRPC = "grpc://"

Link: TypeAlias = "Connection | GrpcConnection"
"""What publishers, subscribers and replays are given: both open senders, subscribe to tracks, and ask."""


def linked(
    connect: str | Sequence[str] | None = None, *, config: str | Path | None = None, timeout: float = 5.0
) -> Link:
    """Open a connection, over gRPC where the endpoints say so, over Zenoh otherwise; arguments as for `Connection`.

    Raises:
        ConnectionFailed: no router or gateway answers within `timeout`, or the endpoints are of both kinds.
    """
    endpoints = (connect,) if isinstance(connect, str) else tuple(connect or ())
    over_grpc = [endpoint.startswith(GRPC) for endpoint in endpoints]
    if not any(over_grpc):
        return Connection(endpoints, config=config, timeout=timeout)
    if not all(over_grpc):
        raise ConnectionFailed("either all endpoints start with grpc://, or none does", endpoints=endpoints)
    try:
        from optipmb_client.grpc import GrpcConnection  # noqa: PLC0415  an extra that only this needs
    except ModuleNotFoundError as error:
        raise ClientError(f"gRPC needs {error.name}, which is not installed: {install_command('grpc')}") from error
    return GrpcConnection(tuple(endpoint.removeprefix(GRPC) for endpoint in endpoints), config=config, timeout=timeout)
