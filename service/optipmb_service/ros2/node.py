"""A node of ROS 2 on a Zenoh session, beside a client of the service on the same session.

Publishers are reliable and volatile. Static transforms are asked of the caches of their publishers, as rmw_zenoh does
for what is TRANSIENT_LOCAL.
"""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from optipmb_service.ros2 import graph
from optipmb_service.zenoh.client import Client

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_client.zenoh.handles import Sender

    from optipmb_service.settings import Settings

MESSAGES: Final = 1024
CLOUDS: Final = 8
"""Messages of a topic, or clouds, between Zenoh and the reader; the oldest goes beyond it."""

JOIN_S: Final = 1.0


@dataclass
class _Publication:
    """What a topic is published with: for nodes that hash types, and for those of Humble, which do not."""

    hashed: Sender
    unhashed: Sender
    gid: bytes
    number: int = 0


class Ros2Node:
    """A node with its publishers and subscriptions.

    Args:
        settings: endpoints, prefix, and what ROS is called.

    Raises:
        TransportError: the network cannot be used. It does not raise but wait for a router.
    """

    def __init__(self, settings: Settings) -> None:
        self.client = Client(settings)
        """The client of the service."""
        self._domain = settings.ros2.domain
        self._node = graph.Node(self._domain, self.client.id, settings.ros2.node)
        self._entities = 0
        self._publications: dict[str, _Publication] = {}
        self.client.token(self._node.token())

    def advertise(self, topic: str, type_name: str, type_hash: str) -> None:
        """Declare a publisher and its token."""
        endpoint = self._endpoint(graph.PUBLISHER, topic, type_name, type_hash, graph.Qos())
        hashed, unhashed = (
            self.client.sender(graph.TopicKey(self._domain, topic, type_name, one).key)
            for one in (type_hash, graph.NO_HASH)
        )
        self._publications[topic] = _Publication(hashed, unhashed, secrets.token_bytes(graph.GID))
        self.client.token(endpoint.token())

    def publish(self, topic: str, payload: bytes) -> None:
        """Send the CDR bytes of a message.

        Raises:
            TransportError: the session is closed.
        """
        publication = self._publications[topic]
        publication.number += 1
        attachment = graph.attachment(publication.number, time.time_ns(), publication.gid)
        publication.hashed.put(payload, attachment)
        if publication.unhashed.wanted:
            publication.unhashed.put(payload, attachment)

    def listened(self, topic: str) -> bool:
        """Whether somebody subscribes to a topic that is published here."""
        publication = self._publications[topic]
        return publication.hashed.wanted or publication.unhashed.wanted

    def subscribe(
        self,
        topic: str,
        type_name: str,
        type_hash: str,
        qos: graph.Qos,
        receive: Callable[[graph.TopicKey, bytes], None],
        *,
        clouds: bool = False,
    ) -> None:
        """Hand over the messages of a topic, of whatever type, on a thread of its own."""
        endpoint = self._endpoint(graph.SUBSCRIPTION, topic, type_name, type_hash, qos)
        pattern = graph.topic_pattern(self._domain, topic)

        def take(at: str, payload: bytes) -> None:
            if (key := graph.parse_topic(at)) is not None:
                receive(key, payload)

        if qos.transient_local:
            self.client.subscribe(pattern, lambda arrival: take(arrival.key, arrival.payload), history=True)
        else:
            most = CLOUDS if clouds else MESSAGES
            self.client.read_newest(pattern, lambda one: take(str(one.key_expr), one.payload.to_bytes()), most=most)
        self.client.token(endpoint.token())

    def watch(self, changed: Callable[[graph.Endpoint, bool], None]) -> None:
        """Tell which publishers and subscriptions come, and go (False); those of this node are left out."""

        def take(key: str, present: bool) -> None:  # noqa: FBT001 - as a token is told
            endpoint = graph.parse_endpoint(key)
            if endpoint is not None and endpoint.node.session != self._node.session:
                changed(endpoint, present)

        self.client.watch(graph.graph_pattern(self._domain), take)

    def close(self) -> None:
        """Withdraw everything and close the session."""
        self.client.close(JOIN_S)

    def _endpoint(self, kind: str, topic: str, type_name: str, type_hash: str, qos: graph.Qos) -> graph.Endpoint:
        self._entities += 1
        return graph.Endpoint(self._node, self._entities, kind, topic, type_name, type_hash, qos)
