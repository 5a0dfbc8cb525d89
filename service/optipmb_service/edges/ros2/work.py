"""Work of the ROS 2 bridge: threads that receive put into one queue, and one thread does the work.

The queue is bounded; when it is full the oldest message goes and is counted. Messages that are sent once stay the
longest: static transforms and changes of endpoints.
"""

from __future__ import annotations

import collections
import threading
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog
from optipmb_schemas.ros2.arrays import CLOUD
from optipmb_schemas.ros2.cpm import CPM
from optipmb_schemas.ros2.tracks import TOPICS

from optipmb_service.edges.ros2 import graph
from optipmb_service.edges.ros2.bridge import DIAGNOSTICS, Ros2Bridge
from optipmb_service.telemetry.health import STUCK_S, Component

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_client.incoming import Arrival

    from optipmb_service.edges.ros2.node import Ros2Node
    from optipmb_service.settings import Settings

    Receive = Callable[[Any], None]

QUEUE: Final = 2048
QUEUE_BYTES: Final = 2**28  # messages that wait for the working thread, and their bytes
DIAGNOSTICS_S: Final = 1.0
TICK_S: Final = 0.02

SENSOR: Final = graph.Qos(reliable=False, depth=10)
MOVING: Final = graph.Qos(reliable=False, depth=100)
STATIC: Final = graph.Qos(transient_local=True, depth=100)
OFFERED: Final = graph.Qos()

TF: Final = "tf2_msgs/msg/TFMessage"
ODOMETRY: Final = "nav_msgs/msg/Odometry"

log = structlog.get_logger("optipmb_service")


class Work(Component):
    """The queue of the working thread, and what connects the node and the bridge."""

    def __init__(self, settings: Settings, node: Ros2Node) -> None:
        super().__init__(node.client)
        self._settings = settings
        self._node = node
        self._bridge = Ros2Bridge(settings, node)
        self._queue: collections.deque[tuple[Callable[[], None], int, bool]] = collections.deque()
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._filled = threading.Event()
        self._shed = 0
        self._next_diagnostics = 0.0
        self._turned = time.monotonic()
        self._endpoints = self._ours()
        single = frozenset(stream.detections for stream in settings.ros2.streams.values())
        self._matching = graph.Matching(tuple(self._endpoints), single)

    @property
    def stuck(self) -> bool:
        """Whether the working thread has been at one piece of work for too long."""
        return time.monotonic() - self._turned > STUCK_S

    def open(self) -> None:
        """Declare everything."""
        for endpoint, receive in self._endpoints.items():
            if receive is None:
                self._node.advertise(endpoint)
            else:
                self._node.subscribe(endpoint, partial(self._receive, endpoint), clouds=endpoint.type == CLOUD)
        self._node.watch(lambda endpoint, came: self._put(lambda: self._changed(endpoint, came=came), once=True))
        for stream in self._settings.ros2.streams:
            self._node.join(stream, lambda message: self._put(lambda: self._come_back(message)))

    def work(self, seconds: float) -> None:
        """Handle messages and timers for about so long."""
        ends = time.monotonic() + seconds
        while (left := ends - time.monotonic()) > 0:
            self._filled.wait(min(left, TICK_S))
            self._filled.clear()
            while (work := self._next()) is not None:
                self._turned = time.monotonic()
                work()
                if self._turned >= ends:  # more comes than can be handled, and the end may have been asked for
                    self._filled.set()
                    break
            self._turned = time.monotonic()
            self._bridge.go_on()
            if time.monotonic() >= self._next_diagnostics:
                self._next_diagnostics = time.monotonic() + DIAGNOSTICS_S
                self._diagnose()

    def _ours(self) -> dict[graph.Endpoint, Receive | None]:
        """Return our endpoints, and the functions that take the messages of subscriptions; None for publishers."""
        ros2, bridge = self._settings.ros2, self._bridge
        subscription = partial(self._node.endpoint, graph.SUBSCRIPTION)
        publisher = partial(self._node.endpoint, graph.PUBLISHER)
        ours: dict[graph.Endpoint, Receive | None] = {
            subscription("/tf", TF, MOVING): partial(bridge.take_transforms, static=False),
            subscription("/tf_static", TF, STATIC): partial(bridge.take_transforms, static=True),
        }
        if ros2.odometry:
            ours[subscription(ros2.odometry, ODOMETRY, MOVING)] = bridge.take_odometry
        for name, stream in ros2.streams.items():
            ours[subscription(stream.detections, stream.type, SENSOR)] = partial(bridge.take, name, "detections")
            if stream.points:
                ours[subscription(stream.points, CLOUD, SENSOR)] = partial(bridge.take, name, "points")
            topics = TOPICS | ({"/cpm": CPM} if stream.cpm else {})
            ours |= {publisher(stream.tracks_topic + end, kind, OFFERED): None for end, kind in topics.items()}
        if ros2.diagnostics:
            ours[publisher(ros2.diagnostics, DIAGNOSTICS, OFFERED)] = None
        return ours

    def _receive(self, endpoint: graph.Endpoint, key: graph.TopicKey, payload: bytes) -> None:
        """Queue a message of the right type; the graph has reported any other."""
        if key.type == endpoint.type and key.hash in {endpoint.hash, graph.NO_HASH}:
            self._put(lambda: self._read(endpoint, payload), len(payload), once=endpoint.qos.transient_local)

    def _read(self, endpoint: graph.Endpoint, payload: bytes) -> None:
        receive = self._endpoints[endpoint]
        assert receive is not None  # noqa: S101  subscriptions have one: said for the type checker
        try:
            if len(payload) > (most := self._settings.limits.max_bytes):
                raise schemas.MessageError("too_large", "", f"at most {most} bytes", f"{len(payload)} bytes")  # noqa: TRY301 - refused as what cannot be read
            receive(self._node.types.read(endpoint.type, payload))
        except schemas.MessageError as error:
            for name, stream in self._settings.ros2.streams.items():
                if endpoint.topic in {stream.detections, stream.points}:
                    self._bridge.refuse(name, error)
                    return
            log.warning("problem", topic=endpoint.topic, message=str(error))

    def _come_back(self, one: Arrival) -> None:
        try:
            if one.key.endswith("/now"):
                self._bridge.take_predicted(one.read(schemas.Tracks))
            elif one.key.endswith("/tracks"):
                self._bridge.take_tracks(one.read(schemas.Tracks))
            else:
                self._bridge.take_problem(one.read(schemas.Problem))
        except schemas.MessageError as error:
            log.warning("problem", key=one.key, message=str(error))

    def _changed(self, endpoint: graph.Endpoint, *, came: bool) -> None:
        for problem in self._matching.change(endpoint, came=came):
            log.warning("ros2_mismatch", message=problem)

    def _put(self, work: Callable[[], None], size: int = 0, *, once: bool = False) -> None:
        with self._lock:
            self._queue.append((work, size, once))
            self._waiting_bytes += size
            while len(self._queue) > QUEUE or self._waiting_bytes > QUEUE_BYTES:
                oldest = next((at for at, (_, _, stays) in enumerate(self._queue) if not stays), 0)
                self._waiting_bytes -= self._queue[oldest][1]
                del self._queue[oldest]
                self._shed += 1
        self._filled.set()

    def _next(self) -> Callable[[], None] | None:
        with self._lock:
            if not self._queue:
                return None
            work, size, _ = self._queue.popleft()
            self._waiting_bytes -= size
            return work

    def _diagnose(self) -> None:
        with self._lock:
            shed, self._shed = self._shed, 0
        if shed:
            log.warning("problem", code="shed", message="the bridge is too slow for what comes in", count=shed)
        if self._settings.ros2.diagnostics:
            self._bridge.diagnose(self._matching.problems())
