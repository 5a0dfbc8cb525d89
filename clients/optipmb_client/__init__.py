"""The client: publish detections and receive tracks from programs of your own, replay and evaluate datasets.

    from optipmb_client import Publisher, Subscriber

The command `optipmb` does everything that needs no programming.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from optipmb_client.errors import ClientError, ConnectionFailed, ServiceRefused, ServiceUnavailable, UsageError
    from optipmb_client.publisher import Publisher
    from optipmb_client.sessions import kept_tracks
    from optipmb_client.subscriber import Missed, Received, Statistics, Subscriber
    from optipmb_client.zenoh import DEFAULT_ENDPOINT, Connection

__all__ = [
    "DEFAULT_ENDPOINT",
    "ClientError",
    "Connection",
    "ConnectionFailed",
    "Missed",
    "Publisher",
    "Received",
    "ServiceRefused",
    "ServiceUnavailable",
    "Statistics",
    "Subscriber",
    "UsageError",
    "kept_tracks",
]


def __getattr__(name: str) -> object:
    """Import what is asked for: the service and offline commands use parts of this package, without the network's."""
    if name in __all__:
        for module in ("errors", "publisher", "sessions", "subscriber", "zenoh"):
            found = import_module(f"optipmb_client.{module}")
            if name in found.__all__:
                return getattr(found, name)
    raise AttributeError(f"module {__name__} has no attribute {name}")
