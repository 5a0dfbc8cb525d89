"""The node API: publish detections and receive tracks from your own programs.

    from optipmb_client import Publisher, Subscriber

The command `optipmb` does everything that needs no programming.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optipmb_client.errors import ClientError, ConnectionFailed, ServiceRefused, ServiceUnavailable, UsageError
    from optipmb_client.publisher import Publisher
    from optipmb_client.sessions import kept_tracks, linked_objects
    from optipmb_client.subscriber import EventSubscriber, Missed, Received, Statistics, Subscriber
    from optipmb_client.zenoh import DEFAULT_ENDPOINT, Connection

__all__ = [
    "DEFAULT_ENDPOINT",
    "ClientError",
    "Connection",
    "ConnectionFailed",
    "EventSubscriber",
    "Missed",
    "Publisher",
    "Received",
    "ServiceRefused",
    "ServiceUnavailable",
    "Statistics",
    "Subscriber",
    "UsageError",
    "kept_tracks",
    "linked_objects",
]

# Imported on first use: offline commands need no Zenoh.
_MODULES = {
    "errors": ("ClientError", "ConnectionFailed", "ServiceRefused", "ServiceUnavailable", "UsageError"),
    "publisher": ("Publisher",),
    "sessions": ("kept_tracks", "linked_objects"),
    "subscriber": ("EventSubscriber", "Missed", "Received", "Statistics", "Subscriber"),
    "zenoh": ("DEFAULT_ENDPOINT", "Connection"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
