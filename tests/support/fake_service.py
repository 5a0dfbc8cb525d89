"""A stand-in for the tracking service: answers as it does, returns one track per detection, misbehaves on request."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Self

import zenoh
from optipmb_client.incoming import Arrival
from optipmb_client.zenoh.session import ZenohSession
from optipmb_schemas import (
    Detections,
    DrainRequest,
    Keys,
    MessageError,
    Points,
    Problem,
    ResetRequest,
    ServiceStatus,
    SessionParameters,
    SessionState,
    SessionSummary,
    Tracks,
    decode,
    encode,
    encoding_of,
)
from routers import open_client
from tracks_message import SESSION, tracks_message

KEYS = Keys()


@dataclass(frozen=True)
class Behaviour:
    """What the fake does with a frame: the tracks to publish for it, given its detections and the true answer."""

    answer: Callable[[Detections, Tracks], list[Tracks]] = lambda _, tracks: [tracks]
    profiles: tuple[str, ...] = ("kitti", "nuscenes", "scene")
    slow_drains: int = 0
    """How often a drain is refused because streams are left."""


@dataclass
class Seen:
    detections: list[Detections] = field(default_factory=list)
    points: list[Points] = field(default_factory=list)
    parameters: list[tuple[str, SessionParameters]] = field(default_factory=list)
    closed: list[str] = field(default_factory=list)
    order: list[tuple[str, int]] = field(default_factory=list)  # topic and stamp
    drains: int = 0


class FakeService:
    """Runs in threads of the test's process from `with` to its end; a client of the router at `endpoint`."""

    def __init__(self, endpoint: str, behaviour: Behaviour | None = None, instance: str = "fake") -> None:
        self.seen = Seen()
        self.instance = instance
        self._endpoint = endpoint
        self._behaviour = behaviour or Behaviour()

    def __enter__(self) -> Self:
        session = self._session = open_client(self._endpoint)
        self._publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        self._lock = threading.Lock()
        self._opened: list[object] = []
        self._opened.append(ZenohSession(session).subscribe(KEYS.all("detections"), self._on_detections))
        self._work(session.declare_subscriber(KEYS.all("points"), zenoh.handlers.FifoChannel(1000)), self._on_points)
        for what, answer in (("parameters", self._on_parameters), ("reset", self._on_reset)):
            self._work(session.declare_queryable(KEYS.all_queries(what), zenoh.handlers.FifoChannel(100)), answer)
        drain = session.declare_queryable(KEYS.drain(self.instance), zenoh.handlers.FifoChannel(100))
        self._work(drain, self._on_drain)
        self._work(
            session.declare_queryable(KEYS.status(self.instance), zenoh.handlers.FifoChannel(100)), self._on_status
        )
        self._opened.append(session.liveliness().declare_token(KEYS.alive(self.instance)))
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()

    def _work(self, source: object, take: Callable[..., None]) -> None:
        self._opened.append(source)

        def loop() -> None:
            for item in source:  # type: ignore[attr-defined]  # every channel of Zenoh can be iterated
                take(item)

        threading.Thread(target=loop, daemon=True).start()

    def _on_detections(self, arrival: Arrival) -> None:
        try:
            message = arrival.read(Detections)
        except MessageError as error:
            stream = KEYS.stream_of(arrival.key)
            problem = Problem.of(error, stream=stream, instance=self.instance)
            self._session.put(KEYS.problems(stream), encode(problem), encoding=encoding_of(Problem))
            return
        self.seen.detections.append(message)
        self.seen.order.append(("detections", message.stamp_ns))
        for answer in self._behaviour.answer(message, tracks_of(message)):
            self._publisher(message.stream).put(encode(answer))

    def _on_points(self, sample: zenoh.Sample) -> None:
        message = decode(sample.payload.to_bytes(), Points, encoding=str(sample.encoding))
        self.seen.points.append(message)
        self.seen.order.append(("points", message.stamp_ns))

    def _publisher(self, stream: str) -> zenoh.ext.AdvancedPublisher:
        if stream not in self._publishers:
            self._publishers[stream] = zenoh.ext.declare_advanced_publisher(
                self._session,
                KEYS.tracks(stream),
                encoding=encoding_of(Tracks),
                cache=zenoh.ext.CacheConfig(100),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.2, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        return self._publishers[stream]

    def _on_parameters(self, query: zenoh.Query) -> None:
        with query:
            stream = KEYS.stream_of(str(query.key_expr))
            payload = query.payload
            wanted = decode(payload.to_bytes(), SessionParameters) if payload is not None else SessionParameters()
            self.seen.parameters.append((stream, wanted))
            if wanted.profile not in (None, *self._behaviour.profiles):
                message = f"profile: expected one of {', '.join(self._behaviour.profiles)}, received {wanted.profile!r}"
                problem = Problem(stream=stream, instance=self.instance, code="invalid_value", message=message)
                query.reply_err(encode(problem), encoding=encoding_of(Problem))
                return
            query.reply(query.key_expr, encode(wanted), encoding=encoding_of(SessionParameters))

    def _on_reset(self, query: zenoh.Query) -> None:
        with query:
            stream = KEYS.stream_of(str(query.key_expr))
            payload = query.payload
            if payload is not None and decode(payload.to_bytes(), ResetRequest).close:
                self.seen.closed.append(stream)
            state = SessionState(stream=stream, session=SESSION, state="closed", profile="kitti")
            query.reply(query.key_expr, encode(state), encoding=encoding_of(SessionState))

    def _on_drain(self, query: zenoh.Query) -> None:
        with query:
            self.seen.drains += 1
            if self.seen.drains <= self._behaviour.slow_drains:
                problem = Problem(
                    stream="", instance=self.instance, code="invalid_value", message="drain: not all taken in time"
                )
                query.reply_err(encode(problem), encoding=encoding_of(Problem))
                return
            query.reply(query.key_expr, encode(DrainRequest()), encoding=encoding_of(DrainRequest))

    def _on_status(self, query: zenoh.Query) -> None:
        with query:
            summary = SessionSummary(stream="a/b/c", profile="kitti", state="running", rate_hz=9.97, frames=1234)
            problem = Problem(stream="a/b/c", instance=self.instance, code="malformed", message="score[3]: too high")
            status = ServiceStatus(
                instance=self.instance,
                version="1.2.3",
                started_ns=1,
                uptime_s=7300.0,
                state="draining" if self.seen.drains else "ready",
                sessions=(summary,),
                frames=1234,
                problems=(problem,),
            )
            query.reply(query.key_expr, encode(status), encoding=encoding_of(ServiceStatus))


def tracks_of(message: Detections) -> Tracks:
    """One track per detection, as if the sensor frame were the world."""
    return tracks_message(
        message.stream,
        message.seq,
        range(len(message.label)),
        epoch=message.epoch,
        stamp_ns=message.stamp_ns,
        cloud_used=bool(message.has_points),
        labels=message.labels,
        label=message.label,
        center=message.center,
        size=message.size,
        yaw=message.yaw,
        score=message.score,
        covariance=0,
        detection=range(len(message.label)),
    )
