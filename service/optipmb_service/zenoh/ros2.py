"""A node of ROS 2 on a Zenoh session, beside a client of the service on the same session.

Publishers are reliable and volatile. Static transforms are asked of the caches of their publishers, as rmw_zenoh does
for what is TRANSIENT_LOCAL.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog
import zenoh
import zenoh.ext

from optipmb_service.ros2 import graph
from optipmb_service.runtime.ports import TransportError
from optipmb_service.zenoh.connection import close, line, opened
from optipmb_service.zenoh.handles import undeclare

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from optipmb_service.settings import Settings
    from optipmb_service.zenoh.handles import Undeclared

CHANNEL: Final = 1024
CLOUDS: Final = 8
"""Clouds between Zenoh and the reader; the oldest goes beyond it."""

CACHE: Final = 200
"""Detections kept for a service that restarts: 10 s at 20 Hz."""

HEARTBEAT_S: Final = 0.2
HISTORY: Final = 100
"""Static transforms that are asked of each publisher."""

log = structlog.get_logger("optipmb_service")


class Ros2Node:
    """A node with its publishers and subscriptions.

    Args:
        settings: endpoints, prefix, and what ROS is called.

    Raises:
        TransportError: the network cannot be used. It does not raise but wait for a router.
    """

    def __init__(self, settings: Settings) -> None:
        self._keys = schemas.Keys(settings.prefix)
        self._session = opened(settings)
        self._domain = settings.ros2.domain
        self._node = graph.Node(self._domain, str(self._session.info.zid()), settings.ros2.node)
        self._entities = 0
        self._held: list[Undeclared] = []
        self._readers: list[tuple[Undeclared, threading.Thread]] = []
        self._publishers: dict[str, tuple[Any, bytes, int]] = {}
        self._senders: dict[tuple[str, type[schemas.Message]], Any] = {}
        self._lock = threading.Lock()
        self._token(self._node.token())

    @property
    def session(self) -> str:
        """The id of the Zenoh session, as tokens name it."""
        return self._node.session

    def linked(self) -> bool:
        """Whether there is a router."""
        return bool(self._session.info.routers_zid())

    # ROS

    def advertise(self, topic: str, type_name: str, type_hash: str) -> None:
        """Declare a publisher and its token."""
        endpoint = self._endpoint(graph.PUBLISHER, topic, type_name, type_hash, graph.Qos())
        key = graph.TopicKey(self._domain, topic, type_name, type_hash).key
        publisher = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._held.append(publisher)
        self._publishers[topic] = (publisher, secrets.token_bytes(16), 0)
        self._token(endpoint.token())

    def publish(self, topic: str, payload: bytes) -> None:
        """Send the CDR bytes of a message.

        Raises:
            TransportError: the session is closed.
        """
        publisher, gid, number = self._publishers[topic]
        self._publishers[topic] = (publisher, gid, number + 1)
        with _closed_told():
            publisher.put(payload, attachment=graph.attachment(number + 1, time.time_ns(), gid))

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

        self._read(topic, subscriber, take)
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

        self._read("graph", tokens, take)

    # The service

    def send(self, stream: str, message: schemas.Detections | schemas.Points) -> None:
        """Publish detections, which stay for recovery, or a cloud, to the service.

        Raises:
            TransportError: the session is closed.
        """
        with _closed_told():
            self._sender(stream, type(message)).put(schemas.encode(message))

    def tell(self, problem: schemas.Problem) -> None:
        """Publish a problem of a stream.

        Raises:
            TransportError: the session is closed.
        """
        with _closed_told():
            key, encoding = self._keys.problems(problem.stream), schemas.encoding_of(problem)
            self._session.put(key, schemas.encode(problem), encoding=encoding)

    def follow(self, stream: str, receive: Callable[[str, bytes, str], None]) -> None:
        """Hand over the tracks and problems of a stream: key, payload, encoding."""
        for key in (self._keys.tracks(stream), self._keys.problems(stream)):
            subscriber = zenoh.ext.declare_advanced_subscriber(
                self._session,
                key,
                zenoh.handlers.FifoChannel(CHANNEL),
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
            self._read(
                key,
                subscriber,
                lambda sample: receive(str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)),
            )

    def close(self) -> None:
        """Withdraw everything and close the session."""
        for declared, _ in self._readers:
            undeclare(declared)
        for _, thread in self._readers:
            thread.join(1.0)
        for declared in reversed(self._held):
            undeclare(declared)
        close(self._session)

    def _endpoint(self, kind: str, topic: str, type_name: str, type_hash: str, qos: graph.Qos) -> graph.Endpoint:
        self._entities += 1
        return graph.Endpoint(self._node, self._entities, kind, topic, type_name, type_hash, qos)

    def _token(self, key: str) -> None:
        self._held.append(self._session.liveliness().declare_token(key))

    def _sender(self, stream: str, kind: type[schemas.Message]) -> Any:
        with self._lock:
            if (stream, kind) not in self._senders:
                encoding = schemas.encoding_of(kind)
                if kind is schemas.Points:
                    sender: Any = self._session.declare_publisher(
                        self._keys.points(stream),
                        encoding=encoding,
                        congestion_control=zenoh.CongestionControl.DROP,
                        priority=zenoh.Priority.DATA_LOW,
                    )
                else:
                    sender = zenoh.ext.declare_advanced_publisher(
                        self._session,
                        self._keys.detections(stream),
                        encoding=encoding,
                        congestion_control=zenoh.CongestionControl.DROP,
                        priority=zenoh.Priority.DATA_HIGH,
                        express=True,
                        cache=zenoh.ext.CacheConfig(CACHE),
                        sample_miss_detection=zenoh.ext.MissDetectionConfig(
                            heartbeat=HEARTBEAT_S, sporadic_heartbeat=None
                        ),
                        publisher_detection=True,
                    )
                self._held.append(sender)
                self._senders[stream, kind] = sender
            return self._senders[stream, kind]

    def _read(self, name: str, declared: Any, receive: Callable[[zenoh.Sample], None]) -> None:
        handler: Iterable[zenoh.Sample] = declared.handler

        def drain() -> None:
            with contextlib.suppress(zenoh.ZError):  # how a channel says that it is closed and empty
                for sample in handler:
                    try:
                        receive(sample)
                    except Exception:
                        log.exception("internal_error", reader=name)  # one message must not end the reading

        thread = threading.Thread(target=drain, name=f"reader-{name}", daemon=True)
        thread.start()
        self._readers.append((declared, thread))


@contextlib.contextmanager
def _closed_told() -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise TransportError(line(error)) from error
