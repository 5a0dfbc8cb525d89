"""The ROS 2 bridge as a process: threads that receive put into one queue, and one thread does the work.

The queue is bounded; when it is full the oldest message goes and is counted.
"""

from __future__ import annotations

import asyncio
import collections
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog
from optipmb_schemas.ros2.arrays import CLOUD
from optipmb_schemas.ros2.tracks import TOPICS
from optipmb_schemas.ros2.types import own_types

from optipmb_service.app import lifecycle
from optipmb_service.app.lifecycle import say_ready, unless
from optipmb_service.ros2 import graph
from optipmb_service.ros2.bridge import Bridge
from optipmb_service.ros2.diagnostics import DIAGNOSTICS, diagnostics
from optipmb_service.ros2.matching import Matching, Wanted
from optipmb_service.ros2.node import Ros2Node
from optipmb_service.runtime.ports import TransportError
from optipmb_service.telemetry.health import BEAT_S, STUCK_S, Reporter

if TYPE_CHECKING:
    from collections.abc import Callable

    from optipmb_client.incoming import Arrival
    from optipmb_client.zenoh.handles import Reading

    from optipmb_service.app.lifecycle import StopRequest
    from optipmb_service.settings import Settings
    from optipmb_service.telemetry.health import ProcessHealth
    from optipmb_service.zenoh.client import Outgoing

QUEUE: Final = 2048
QUEUE_BYTES: Final = 2**28  # messages that wait for the working thread, and their bytes
CACHE: Final = 400  # detections of a stream kept for a service that restarts: 10 s at 20 Hz
DIAGNOSTICS_S: Final = 1.0
TICK_S: Final = 0.02
QUERY_S: Final = 2.0

SENSOR: Final = graph.Qos(reliable=False, depth=10)
MOVING: Final = graph.Qos(reliable=False, depth=100)
STATIC: Final = graph.Qos(transient_local=True, depth=100)
OFFERED: Final = graph.Qos()

TF: Final = "tf2_msgs/msg/TFMessage"
ODOMETRY: Final = "nav_msgs/msg/Odometry"

log = structlog.get_logger("optipmb_service")


class _Work(Reporter):
    """The node, the bridge and what wires them; what the process reports."""

    def __init__(self, settings: Settings, node: Ros2Node) -> None:
        super().__init__(lambda: node.client.failure)
        self._settings = settings
        self._node = node
        self._types = own_types()
        self._bridge = Bridge(settings.ros2, settings.instance, self._types, self, time.monotonic)
        self._outgoing: dict[str, Outgoing] = {}
        self._subscriptions: list[Reading] = []
        self._queue: collections.deque[tuple[Callable[[], None], int]] = collections.deque()
        self._waiting_bytes = 0
        self._asking = ThreadPoolExecutor(1, "ask")
        self._asked: set[str] = set()
        self._lock = threading.Lock()
        self._filled = threading.Event()
        self._shed = 0
        self._reported_shed = 0
        self._reported_problems: dict[str, int] = {}
        self._next_diagnostics = 0.0
        self._turned = time.monotonic()
        self._topics = tuple(self._wanted())
        single = frozenset(stream.detections for stream in settings.ros2.streams.values())
        self._matching = Matching(tuple(wanted for wanted, _ in self._topics), single)

    @property
    def stuck(self) -> bool:
        """Whether the working thread has been at one piece of work for too long."""
        return time.monotonic() - self._turned > STUCK_S

    def open(self) -> None:
        """Declare everything."""
        for wanted, receive in self._topics:
            if receive is None:
                self._node.advertise(wanted.topic, wanted.type, wanted.hash)
            else:
                take = self._reading(wanted, receive)
                clouds = wanted.type == CLOUD
                self._node.subscribe(wanted.topic, wanted.type, wanted.hash, wanted.qos, take, clouds=clouds)
        self._node.watch(lambda endpoint, came: self._put(lambda: self._changed(endpoint, came=came)))
        client = self._node.client
        for stream in self._settings.ros2.streams:
            self._outgoing[stream] = client.publish(stream, CACHE, cache_clouds=0, wanted=lambda: None)
            for key in (client.keys.tracks(stream), client.keys.problems(stream)):
                come_back = client.subscribe(key, lambda message: self._put(lambda: self._come_back(message)))
                self._subscriptions.append(come_back)

    def close(self) -> None:
        """Withdraw everything and close the session."""
        for subscription in self._subscriptions:
            subscription.close()
        for outgoing in self._outgoing.values():
            outgoing.close()
        self._asking.shutdown(cancel_futures=True)
        self._node.close()

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

    # What the bridge sends

    def send(self, stream: str, message: schemas.Detections | schemas.Points) -> None:
        """Publish to the service."""
        outgoing, payload = self._outgoing[stream], schemas.encode(message)
        if isinstance(message, schemas.Points):
            outgoing.points(payload)
        else:
            outgoing.detections(payload)

    def tell(self, problem: schemas.Problem) -> None:
        """Log a problem and publish it."""
        log.warning("problem", stream=problem.stream, code=problem.code, message=problem.message)
        self._node.client.publish_problem(problem)

    def publish(self, topic: str, message: Any) -> None:
        """Publish to ROS."""
        self._node.publish(topic, self._types.write(message))

    def listened(self, topic: str) -> bool:
        """Return whether ROS has a subscription to a topic."""
        return self._node.listened(topic)

    def ask(self, stream: str, parameters: schemas.SessionParameters, then: Callable[[], None] | None = None) -> None:
        """Set parameters of a stream's session, on a thread of its own; without `then` one request at a time."""
        if then is not None or stream not in self._asked:
            self._asked.add(stream)
            self._asking.submit(self._ask, stream, parameters, then)

    def _ask(self, stream: str, parameters: schemas.SessionParameters, then: Callable[[], None] | None) -> None:
        client = self._node.client
        key, encoding = client.keys.query(stream, "parameters"), schemas.encoding_of(parameters)
        try:
            answers = client.query(key, schemas.encode(parameters), encoding, timeout=QUERY_S)
            if not any(answer.ok for answer in answers):
                said = schemas.decode(answers[0].payload, schemas.Problem).message if answers else "nobody answered"
                log.warning("problem", stream=stream, message=f"parameters of its session: {said}")
        except (TransportError, schemas.MessageError) as error:
            log.warning("problem", stream=stream, message=f"parameters of its session: {error}")
        finally:
            self._asked.discard(stream)
            if then is not None:
                self._put(then)

    # Incoming messages

    def _wanted(self) -> list[tuple[Wanted, Callable[[Any], None] | None]]:
        """Return our endpoints, and what takes the messages of subscriptions; None for publishers."""
        ros2, bridge = self._settings.ros2, self._bridge

        def one(kind: str, topic: str, type_name: str, qos: graph.Qos) -> Wanted:
            return Wanted(kind, topic, type_name, self._types.hash_of(type_name), qos)

        subscription, publisher = partial(one, graph.SUBSCRIPTION), partial(one, graph.PUBLISHER)
        ours: list[tuple[Wanted, Callable[[Any], None] | None]] = [
            (subscription("/tf", TF, MOVING), partial(bridge.take_transforms, static=False)),
            (subscription("/tf_static", TF, STATIC), partial(bridge.take_transforms, static=True)),
        ]
        if ros2.odometry:
            ours.append((subscription(ros2.odometry, ODOMETRY, MOVING), bridge.take_odometry))
        for name, stream in ros2.streams.items():
            take: Any = partial(bridge.take, name)
            ours.append((subscription(stream.detections, stream.type, SENSOR), partial(take, "detections")))
            if stream.points:
                ours.append((subscription(stream.points, CLOUD, SENSOR), partial(take, "points")))
            ours += [(publisher(stream.tracks_topic + end, kind, OFFERED), None) for end, kind in TOPICS.items()]
        if ros2.diagnostics:
            ours.append((publisher(ros2.diagnostics, DIAGNOSTICS, OFFERED), None))
        return ours

    def _reading(self, wanted: Wanted, receive: Callable[[Any], None]) -> Callable[[graph.TopicKey, bytes], None]:
        """Return the receiver of a topic, which reads messages of the right type and hands them over."""

        def take(key: graph.TopicKey, payload: bytes) -> None:
            if key.type == wanted.type and key.hash in {wanted.hash, graph.NO_HASH}:  # else the graph has reported it
                self._put(lambda: self._read(wanted, payload, receive), len(payload))

        return take

    def _read(self, wanted: Wanted, payload: bytes, receive: Callable[[Any], None]) -> None:
        try:
            if len(payload) > (most := self._settings.limits.max_bytes):
                raise schemas.MessageError("too_large", "", f"at most {most} bytes", f"{len(payload)} bytes")  # noqa: TRY301 - refused as what cannot be read
            receive(self._types.read(wanted.type, payload))
        except schemas.MessageError as error:
            for name, stream in self._settings.ros2.streams.items():
                if wanted.topic in {stream.detections, stream.points}:
                    self._bridge.refuse(name, error)
                    return
            log.warning("problem", topic=wanted.topic, message=str(error))

    def _come_back(self, one: Arrival) -> None:
        try:
            if one.key.endswith("/tracks"):
                self._bridge.take_tracks(schemas.decode(one.payload, schemas.Tracks, encoding=one.encoding))
            else:
                self._bridge.take_problem(schemas.decode(one.payload, schemas.Problem, encoding=one.encoding))
        except schemas.MessageError as error:
            log.warning("problem", key=one.key, message=str(error))

    def _changed(self, endpoint: graph.Endpoint, *, came: bool) -> None:
        for problem in self._matching.change(endpoint, came=came):
            log.warning("ros2_mismatch", message=problem)

    def _put(self, work: Callable[[], None], size: int = 0) -> None:
        with self._lock:
            self._queue.append((work, size))
            self._waiting_bytes += size
            while len(self._queue) > QUEUE or self._waiting_bytes > QUEUE_BYTES:
                self._waiting_bytes -= self._queue.popleft()[1]
                self._shed += 1
        self._filled.set()

    def _next(self) -> Callable[[], None] | None:
        with self._lock:
            if not self._queue:
                return None
            work, size = self._queue.popleft()
            self._waiting_bytes -= size
            return work

    def _diagnose(self) -> None:
        counts = self._bridge.counts
        new = {name: one.problems - self._reported_problems.get(name, 0) for name, one in counts.items()}
        self._reported_problems = {name: one.problems for name, one in counts.items()}
        if shed := self._shed - self._reported_shed:
            self._reported_shed += shed
            log.warning("problem", code="shed", message="the bridge is too slow for what comes in", count=shed)
        if not self._settings.ros2.diagnostics:
            return
        message = diagnostics(
            self._types,
            time.time_ns(),
            self._settings.instance,
            counts,
            self._matching.problems(),
            new_problems=new,
            now_s=time.monotonic(),
            stale_s=self._settings.stale_s,
        )
        self.publish(self._settings.ros2.diagnostics, message)


async def run(settings: Settings) -> int:
    """Bridge until SIGINT or SIGTERM; returns the exit status, as `lifecycle.run` does."""

    async def serve(asked: StopRequest, health: ProcessHealth) -> bool | None:
        log.info("connecting", endpoints=settings.connect)
        node = await unless(asked, lambda: Ros2Node(settings))
        if node is None:
            return None
        work = _Work(settings, node)
        try:
            work.open()
            health.report(work)
            streams = ",".join(settings.ros2.streams)
            say_ready("ros2", streams, settings.connect)
            log.info("ready", instance=settings.instance, streams=streams, connect=settings.connect)
            while not asked.is_set():
                await asyncio.to_thread(work.work, BEAT_S)
            health.ends()
        finally:
            asked.bound.begin()
            await asyncio.to_thread(work.close)
        return True

    return await lifecycle.run(settings, serve)
