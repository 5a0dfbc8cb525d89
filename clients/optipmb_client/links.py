"""The two ways to a tracking service: Zenoh, which is the native one, and gRPC, by the endpoints that are given."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from optipmb_schemas import Message
from optipmb_schemas.installation import install_command

from optipmb_client.errors import ClientError, ConnectionFailed
from optipmb_client.incoming import Answer, Inbox
from optipmb_client.zenoh import Connection

__all__ = ["GRPC", "Link", "SendsMessages", "Subscribed", "linked"]

GRPC = "grpc://"


class SendsMessages(Protocol):
    """Sends the messages of one topic of a stream."""

    @property
    def wanted(self) -> bool:
        """Whether anybody takes them, or may come for them later."""

    def pack(self, message: Message) -> bytes:
        """Return a message as it is sent."""

    def put(self, payload: bytes) -> None:
        """Send a packed message; waits for nobody."""

    def close(self) -> None:
        """Withdraw; what was sent before goes out."""


class Subscribed(Protocol):
    """A subscription that fills an inbox."""

    def close(self) -> None:
        """End it; what is in the inbox stays readable."""


class Link(Protocol):
    """What publishers, subscribers and replays use of a connection."""

    def senders(
        self, stream: str, *, prefix: str, cache: int, cache_clouds: int
    ) -> tuple[SendsMessages, SendsMessages]:
        """Return what sends the detections and the clouds of a stream."""

    def subscribe_tracks(self, pattern: str, inbox: Inbox, *, prefix: str, problems: bool) -> Subscribed:
        """Move the tracks of a pattern into an inbox, its problems too where that is asked for."""

    def query(self, key: str, payload: bytes = b"", encoding: str = "", *, timeout: float = 2.0) -> tuple[Answer, ...]:
        """Ask everybody who answers at a key; nothing when nobody does in time."""

    def close(self) -> None:
        """Close everything that was opened here."""


def linked(
    connect: str | Sequence[str] | None = None, *, config: str | Path | None = None, timeout: float = 5.0
) -> Link:
    """Open a connection, over gRPC where the endpoints say so, over Zenoh otherwise; arguments as for `Connection`.

    Raises:
        ConnectionFailed: nobody answers within `timeout`, or the endpoints are of both kinds.
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
