"""A node of ROS 2 on a Zenoh session, beside a client of the service on the same session.

Publishers are reliable and volatile. Static transforms are asked of the caches of their publishers, as rmw_zenoh does
for what is TRANSIENT_LOCAL.
"""

from __future__ import annotations

import secrets
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import zenoh
import zenoh.ext

from optipmb_service.ros2 import graph
from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh.client import Client
from optipmb_service.zenoh.connection import line, opened
from optipmb_service.zenoh.handles import Readers, undeclare

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.handles import Undeclared

CHANNEL: Final = 1024
CLOUDS: Final = 8
"""Clouds between Zenoh and the reader; the oldest goes beyond it."""

HISTORY: Final = 100
"""Static transforms that are asked of each publisher."""

JOIN_S: Final = 1.0


@dataclass
class _Publication:
    """What a topic is published with: for nodes that hash types, and for those of Humble, which do not."""

    hashed: Any
    unhashed: Any
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
        self._session = opened(settings)
        self.client = Client(self._session, settings.prefix)
        """The client of the service."""
        self._domain = settings.ros2.domain
        self._node = graph.Node(self._domain, str(self._session.info.zid()), settings.ros2.node)
        self._entities = 0
        self._held: list[Undeclared] = []
        self._readers = Readers()
        self._publications: dict[str, _Publication] = {}
        self._token(self._node.token())

    def advertise(self, topic: str, type_name: str, type_hash: str) -> None:
        """Declare a publisher and its token."""
        endpoint = self._endpoint(graph.PUBLISHER, topic, type_name, type_hash, graph.Qos())
        hashed, unhashed = (
            self._session.declare_publisher(
                graph.TopicKey(self._domain, topic, type_name, one).key,
                congestion_control=zenoh.CongestionControl.DROP,
            )
            for one in (type_hash, graph.NO_HASH)
        )
        self._held += [hashed, unhashed]
        self._publications[topic] = _Publication(hashed, unhashed, secrets.token_bytes(graph.GID))
        self._token(endpoint.token())

    def publish(self, topic: str, payload: bytes) -> None:
        """Send the CDR bytes of a message.

        Raises:
            TransportError: the session is closed.
        """
        publication = self._publications[topic]
        publication.number += 1
        attachment = graph.attachment(publication.number, time.time_ns(), publication.gid)
        try:
            publication.hashed.put(payload, attachment=attachment)
            if publication.unhashed.matching_status.matching:
                publication.unhashed.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            raise TransportError(line(error)) from error

    def listened(self, topic: str) -> bool:
        """Whether somebody subscribes to a topic that is published here."""
        publication = self._publications[topic]
        return any(one.matching_status.matching for one in (publication.hashed, publication.unhashed))

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
        subscriber: Any
        if qos.transient_local:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session,
                pattern,
                zenoh.handlers.FifoChannel(CHANNEL),
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=HISTORY),
            )
        else:
            channel: Any = zenoh.handlers.RingChannel(CLOUDS) if clouds else zenoh.handlers.FifoChannel(CHANNEL)
            subscriber = self._session.declare_subscriber(pattern, channel)

        def take(sample: zenoh.Sample) -> None:
            key = graph.parse_topic(str(sample.key_expr))
            if key is not None and sample.kind == zenoh.SampleKind.PUT:
                receive(key, sample.payload.to_bytes())

        self._readers.add(topic, subscriber, subscriber.handler, take)
        self._token(endpoint.token())

    def watch(self, changed: Callable[[graph.Endpoint, bool], None]) -> None:
        """Tell which publishers and subscriptions come, and go (False); those of this node are left out."""
        tokens = self._session.liveliness().declare_subscriber(
            graph.graph_pattern(self._domain), zenoh.handlers.FifoChannel(CHANNEL), history=True
        )

        def take(sample: zenoh.Sample) -> None:
            endpoint = graph.parse_endpoint(str(sample.key_expr))
            if endpoint is not None and endpoint.node.session != self._node.session:
                changed(endpoint, sample.kind == zenoh.SampleKind.PUT)

        self._readers.add("graph", tokens, tokens.handler, take)

    def close(self) -> None:
        """Withdraw everything and close the session."""
        self._readers.stop(JOIN_S)
        for declared in reversed(self._held):
            undeclare(declared)
        self.client.close()

    def _endpoint(self, kind: str, topic: str, type_name: str, type_hash: str, qos: graph.Qos) -> graph.Endpoint:
        self._entities += 1
        return graph.Endpoint(self._node, self._entities, kind, topic, type_name, type_hash, qos)

    def _token(self, key: str) -> None:
        self._held.append(self._session.liveliness().declare_token(key))
