"""A node of ROS 2 and a client of the service on one Zenoh session.

Publishers are reliable and volatile. Static transforms are asked of the caches of their publishers, as rmw_zenoh does
for TRANSIENT_LOCAL topics.
"""

from __future__ import annotations

import secrets
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ConnectionFailed
from optipmb_schemas.ros2.types import own_types

from optipmb_service.edges.ros2 import graph
from optipmb_service.zenoh.client import Client

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_client.incoming import Arrival
    from optipmb_client.zenoh.handles import Sender

    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.client import Outgoing

MESSAGES: Final = 1024
CLOUDS: Final = 8
"""Messages of a topic, or clouds, between Zenoh and the reader; the oldest goes beyond it."""

JOIN_S: Final = 1.0
CACHE: Final = 400  # detections of a stream kept for a service that restarts: 10 s at 20 Hz

log = structlog.get_logger("optipmb_service")


class Ros2Node:
    """A node with its publishers and subscriptions, and the streams of the service that it feeds.

    Args:
        settings: endpoints, prefix, and what ROS is called.

    Raises:
        TransportError: the network cannot be used. It does not raise but wait for a router.
    """

    def __init__(self, settings: Settings) -> None:
        self.client = Client(settings)
        """The client of the service."""
        self.types = own_types(perception=any(one.cpm for one in settings.ros2.streams.values()))
        self._predicted = {name for name, one in settings.ros2.streams.items() if one.cpm and settings.output_of(name)}
        self._domain = settings.ros2.domain
        self._node = graph.Node(self._domain, self.client.id, settings.ros2.node)
        self._entities = 0
        self._gids: dict[str, bytes] = {}
        self._numbers: dict[str, int] = {}
        self._senders: dict[str, tuple[Sender, Sender]] = {}
        """Publishers of a topic: for nodes that hash types, and for nodes of Humble, which do not."""
        self._outgoing: dict[str, Outgoing] = {}
        self._asking = ThreadPoolExecutor(1, "ask")
        self._asked: set[str] = set()
        self.client.token(self._node.token())

    # ROS

    def endpoint(self, kind: str, topic: str, type_name: str, qos: graph.Qos) -> graph.Endpoint:
        self._entities += 1
        return graph.Endpoint(self._node, self._entities, kind, topic, type_name, self.types.hash_of(type_name), qos)

    def advertise(self, endpoint: graph.Endpoint) -> None:
        """Declare a publisher and its token."""
        hashed, unhashed = (
            self.client.sender(graph.TopicKey(self._domain, endpoint.topic, endpoint.type, one).key)
            for one in (endpoint.hash, graph.NO_HASH)
        )
        self._senders[endpoint.topic] = hashed, unhashed
        self._gids[endpoint.topic] = secrets.token_bytes(graph.GID)
        self.client.token(endpoint.token())

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message to ROS.

        Raises:
            TransportError: the session is closed.
            MessageError: ROS has no place for a value of it.
        """
        hashed, unhashed = self._senders[topic]
        payload, number = self.types.write(message), self._numbers.get(topic, 0) + 1
        self._numbers[topic] = number
        attachment = graph.attachment(number, time.time_ns(), self._gids[topic])
        hashed.put(payload, attachment)
        if unhashed.wanted:
            unhashed.put(payload, attachment)

    def listened(self, topic: str) -> bool:
        """Return whether ROS has a subscription to a topic that is published here."""
        return any(sender.wanted for sender in self._senders[topic])

    def subscribe(
        self, endpoint: graph.Endpoint, receive: Callable[[graph.TopicKey, bytes], None], *, clouds: bool = False
    ) -> None:
        """Hand over the messages of a topic, of any type, on a thread of its own."""
        pattern = graph.topic_pattern(self._domain, endpoint.topic)

        def take(at: str, payload: bytes) -> None:
            if (key := graph.parse_topic(at)) is not None:
                receive(key, payload)

        if endpoint.qos.transient_local:
            self.client.subscribe(pattern, lambda arrival: take(arrival.key, arrival.payload), history=True)
        else:
            most = CLOUDS if clouds else MESSAGES
            self.client.read_newest(pattern, lambda one: take(str(one.key_expr), one.payload.to_bytes()), most=most)
        self.client.token(endpoint.token())

    def watch(self, changed: Callable[[graph.Endpoint, bool], None]) -> None:
        """Tell which publishers and subscriptions come, and go (False), but for this node's."""

        def take(key: str, present: bool) -> None:  # noqa: FBT001 - the signature of a watcher
            endpoint = graph.parse_endpoint(key)
            if endpoint is not None and endpoint.node.session != self._node.session:
                changed(endpoint, present)

        self.client.watch(graph.graph_pattern(self._domain), take)

    # The service

    def join(self, stream: str, receive: Callable[[Arrival], object]) -> None:
        """Open the publishers of a stream, and hand over its tracks and problems, and what CPM are made of."""
        self._outgoing[stream] = self.client.publish(stream, CACHE, cache_clouds=0, wanted=lambda: None)
        keys = self.client.keys
        now = [keys.now(stream)] if stream in self._predicted else []
        for key in (keys.tracks(stream), keys.problems(stream), *now):
            self.client.subscribe(key, receive)

    def send(self, stream: str, message: schemas.Detections | schemas.Points) -> None:
        """Publish detections or a cloud to the service."""
        outgoing = self._outgoing[stream]
        put = outgoing.points if isinstance(message, schemas.Points) else outgoing.detections
        put(schemas.encode(message))

    def report(self, problem: schemas.Problem) -> None:
        """Log a problem and publish it."""
        log.warning("problem", stream=problem.stream, code=problem.code, message=problem.message)
        self.client.publish_problem(problem)

    def set_parameters(
        self, stream: str, parameters: schemas.SessionParameters, then: Callable[[], None] | None = None
    ) -> None:
        """Set parameters of a stream's session, on a thread of its own; without `then` one request at a time.

        `then` is called on that thread when it is done, or has failed.
        """
        if then is not None or stream not in self._asked:
            self._asked.add(stream)
            self._asking.submit(self._set, stream, parameters, then)

    def _set(self, stream: str, parameters: schemas.SessionParameters, then: Callable[[], None] | None) -> None:
        key, encoding = self.client.keys.query(stream, "parameters"), schemas.encoding_of(parameters)
        why = ""
        try:
            answers = self.client.query(key, schemas.encode(parameters), encoding)
            if not any(answer.ok for answer in answers):
                why = schemas.decode(answers[0].payload, schemas.Problem).message if answers else "nobody answered"
        except (ConnectionFailed, schemas.MessageError) as error:
            why = str(error)
        if why:
            log.warning("problem", stream=stream, message=f"parameters of its session: {why}")
        self._asked.discard(stream)
        if then is not None:
            then()

    def close(self) -> None:
        """Withdraw everything and close the session."""
        self._asking.shutdown(cancel_futures=True)
        self.client.close(JOIN_S)
