"""The client: publish detections and receive tracks from programs of your own, replay and evaluate datasets.

    from optipmb_client import Publisher, Subscriber

The command `optipmb` does everything that needs no programming.
"""

from optipmb_client.errors import ClientError, ConnectionFailed, ServiceRefused, ServiceUnavailable, UsageError
from optipmb_client.history import kept_tracks
from optipmb_client.publisher import Publisher
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
