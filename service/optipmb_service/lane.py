"""A stream's way through the service: decode, session, publish, all on one worker at a time, so nothing is locked here.

A lane is made for whatever arrives on a stream's key, its session only for a valid message: garbage costs a lane that
is gone when its inbox is empty. Clocks: `now_ns` monotonic for all decisions, the wall clock only for what delivery
reports.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog

from optipmb_service.inbox import Inbox
from optipmb_service.meter import Meter
from optipmb_service.ports import Packet, TransportError
from optipmb_service.problems import problem_of
from optipmb_service.records import SECOND, Begun, Life, Output, Policy, Quarantined, Tracked
from optipmb_service.session import Session

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import optipmb
    from optipmb_service.metrics import Metrics
    from optipmb_service.ports import Claim, Outlet
    from optipmb_service.problems import Desk

log = structlog.get_logger("optipmb_service")

BATCH: Final = 8
"""Items that a worker takes before the other streams have their turn."""

MILLISECOND: Final = 1e6


@dataclass(frozen=True)
class Circle:
    """What all lanes share.

    Attributes:
        instance: name of the service.
        limits: bounds on messages.
        policy: waiting and restarting of sessions.
        queue_frames: most frames waiting per stream.
        queue_clouds: most clouds waiting per stream.
        outlet: where results go.
        desk: where problems go.
        parameters_of: profile of a stream.
        admit: asked before a session begins; returns what the stream had before, None when there is no room.
        release: told when a session has ended.
        discard: told when a lane without a session has nothing left to do.
        submit: sends a worker to a lane.
        arm: has `Lane.wake` called at a monotonic time (ns).
        metrics: counts what is published.
        tracker: makes trackers.
    """

    instance: str
    limits: schemas.Limits
    policy: Policy
    queue_frames: int
    queue_clouds: int
    outlet: Outlet
    desk: Desk
    parameters_of: Callable[[str], optipmb.Parameters]
    admit: Callable[[str], Life | None]
    release: Callable[[Session], None]
    discard: Callable[[Lane], None]
    submit: Callable[[Lane], None]
    arm: Callable[[Lane, int], None]
    metrics: Metrics
    tracker: Callable[[optipmb.Parameters], Any]


@dataclass(frozen=True, slots=True)
class _Ticket:
    """What is known of a frame's way when its tracks come out."""

    wall_ns: int
    now_ns: int
    decode_ns: int


class Lane:
    """One stream.

    Args:
        stream: `site/node/sensor`.
        circle: what all lanes share.
    """

    def __init__(self, stream: str, circle: Circle) -> None:
        self.stream = stream
        self.inbox = Inbox(circle.queue_frames, circle.queue_clouds)
        self.meter = Meter(time.monotonic_ns())
        self.session: Session | None = None
        self.stale = False
        self.refused = 0
        """Messages refused while there was no session to count them."""
        self._circle = circle
        self._claim: Claim | None = None
        self._armed_ns: int | None = None
        self._shed_told = 0
        self._ids: frozenset[int] = frozenset()

    def wake(self) -> None:
        """Send a worker though nothing came: frames have waited long enough."""
        if self.inbox.ring():
            self._circle.submit(self)

    # The worker's turn

    def work(self) -> bool:
        """Take some of what waits; True: come again."""
        for _ in range(BATCH):
            taken = self.inbox.take()
            if taken is None:
                break
            self._guard(self._handle, *taken)
        self._guard(self._settle)
        turn = self.inbox.leave(close=self.session is None)
        if turn is None:
            self._circle.discard(self)
        return bool(turn)

    def _guard(self, work: Callable[..., None], *arguments: Any) -> None:
        """Do a piece of work; whatever it raises, the stream and its worker go on."""
        try:
            work(*arguments)
        except Exception as error:
            log.exception("internal_error", stream=self.stream)
            self._report("internal", "", "a message handled without an error", f"{type(error).__name__}: {error}")

    def _handle(self, kind: str, item: Packet | Callable[[], None]) -> None:
        if isinstance(item, Packet):
            self._receive(item, frame=kind == "frame")
        else:
            item()

    def _settle(self) -> None:
        """Let go what has waited long enough, and have the worker come back for what has not."""
        shed = self.inbox.shed_frames - self._shed_told
        if shed:
            self._shed_told += shed
            expected = f"at most {self._circle.queue_frames} frames waiting"
            self._report("shed", "", expected, f"{shed} more; the oldest were dropped", count=shed)
        session = self.session
        if session is None or (deadline_ns := session.deadline_ns) is None:
            return
        now_ns = time.monotonic_ns()
        if deadline_ns <= now_ns and not self.inbox.clouds_waiting:
            self._deliver(session.on_tick(now_ns))
            deadline_ns = session.deadline_ns
        if deadline_ns is not None and deadline_ns != self._armed_ns:
            self._armed_ns = deadline_ns
            self._circle.arm(self, deadline_ns)

    # Messages

    def _receive(self, packet: Packet, *, frame: bool) -> None:
        began_ns = time.perf_counter_ns()
        kind = schemas.Detections if frame else schemas.Points
        try:
            message = self._decode(packet, kind)
        except schemas.MessageError as error:
            self._count_refused()
            self._report(error.code, error.path, error.expected, error.received, what=kind.__name__)
            return
        session = self.session or self.open_session()
        if session is None:
            return
        now_ns = time.monotonic_ns()
        self.meter.arrived(packet.now_ns, frame=frame)
        if self.stale and frame:
            self.stale = False
            log.info("stream_back", stream=self.stream)
        ticket = _Ticket(packet.wall_ns, packet.now_ns, time.perf_counter_ns() - began_ns)
        if isinstance(message, schemas.Points):
            outputs = session.on_points(message, now_ns, ticket=ticket)
        else:
            outputs = session.on_detections(message, now_ns, arrived_ns=packet.now_ns, ticket=ticket)
        self._deliver(outputs)

    def _decode(
        self, packet: Packet, kind: type[schemas.Detections | schemas.Points]
    ) -> schemas.Detections | schemas.Points:
        """Return the message of a packet.

        Raises:
            MessageError: it is none, or not one of this stream.
        """
        limits = self._circle.limits
        if packet.payload is None:
            raise schemas.MessageError("too_large", "", f"at most {limits.max_bytes} bytes", f"{packet.size} bytes")
        message = schemas.decode(packet.payload, kind, encoding=packet.encoding, limits=limits)
        if message.stream != self.stream:
            raise schemas.MessageError("invalid_value", "stream", repr(self.stream), repr(message.stream))
        return message

    def _count_refused(self) -> None:
        if self.session is None:
            self.refused += 1
        else:
            self.session.refuse()

    def _deliver(self, outputs: Sequence[Output]) -> None:
        for output in outputs:
            if isinstance(output, Tracked):
                self._publish(output)
            elif isinstance(output, Begun):
                log.info(
                    "session_begun",
                    stream=self.stream,
                    session=output.session,
                    reason=output.reason,
                    profile=self.session.parameters.name if self.session else "",
                    jump_s=output.jump_ns / 1e9,
                )
            elif isinstance(output, Quarantined):
                log.error("session_quarantined", stream=self.stream, error=output.error)
            else:
                self._circle.desk.report(output, time.monotonic_ns())

    def _publish(self, tracked: Tracked) -> None:
        ticket: _Ticket = tracked.ticket
        passed_ns = time.monotonic_ns() - ticket.now_ns
        waited_ns = max(0, passed_ns - ticket.decode_ns - tracked.step_ns)
        delivery = schemas.Delivery(
            instance=self._circle.instance,
            received_ns=ticket.wall_ns,
            published_ns=time.time_ns(),
            queue_ms=waited_ns / MILLISECOND,
            decode_ms=ticket.decode_ns / MILLISECOND,
            step_ms=tracked.step_ns / MILLISECOND,
        )
        payload = schemas.encode(tracked.tracks.model_copy(update={"delivery": delivery}))
        try:
            if self._claim is not None:
                self._claim.publish(payload)
        except TransportError as error:
            log.warning("publish_failed", stream=self.stream, error=str(error))
            return
        latency_ns = time.monotonic_ns() - ticket.now_ns
        self.meter.published(latency_ns)
        self._circle.metrics.published(
            latency_s=latency_ns / SECOND,
            queue_s=waited_ns / SECOND,
            decode_s=ticket.decode_ns / SECOND,
            step_s=tracked.step_ns / SECOND,
        )
        self._count_tracks(frozenset(tracked.tracks.id.tolist()))

    def _count_tracks(self, ids: frozenset[int]) -> None:
        self._circle.metrics.tracks(started=len(ids - self._ids), ended=len(self._ids - ids))
        self._ids = ids

    def _report(self, code: str, path: str, expected: str, received: str, *, what: str = "", count: int = 1) -> None:
        message = f"{what or 'Stream'}: {path or 'message'}: expected {expected}, received {received}."
        problem = problem_of(
            code,
            stream=self.stream,
            instance=self._circle.instance,
            path=path,
            expected=expected,
            received=received,
            message=message,
            count=count,
        )
        self._circle.desk.report(problem, time.monotonic_ns())

    # Sessions; to be called by the worker alone

    def open_session(self) -> Session | None:
        """Begin a session; None when the service has no room for another."""
        life = self._circle.admit(self.stream)
        if life is None:
            self._count_refused()
            self._report(
                "refused", "", "a stream that is tracked already", "a new one; the service carries no more sessions"
            )
            return None
        try:
            self._claim = self._circle.outlet.claim(self.stream)
        except TransportError as error:
            log.warning("claim_failed", stream=self.stream, error=str(error))
        self.session = Session(
            self.stream,
            self._circle.parameters_of(self.stream),
            self._circle.policy,
            instance=self._circle.instance,
            life=life,
            tracker=self._circle.tracker,
        )
        log.info("session_opened", stream=self.stream, profile=self.session.parameters.name)
        return self.session

    def close_session(self, reason: str) -> None:
        """End the session and free what it holds; the next valid message of the stream begins another."""
        session, claim = self.session, self._claim
        if session is None:
            return
        self._deliver(session.flush())
        self.session, self._claim, self._armed_ns = None, None, None
        self._count_tracks(frozenset())
        self._circle.release(session)
        if claim is not None:
            claim.release()
        log.info(
            "session_closed", stream=self.stream, session=session.session, reason=reason, frames=session.counters.frames
        )

    def deliver(self, outputs: Sequence[Output]) -> None:
        """Publish what a command to the session brought."""
        self._deliver(outputs)

    def state(self) -> schemas.SessionState | None:
        """Return the state of the session, None without one."""
        return self.session.state(shed=self.inbox.shed_frames, queue=self.inbox.waiting) if self.session else None

    def summary(self, now_ns: int) -> schemas.SessionSummary | None:
        """Return the line of the service's status; may be called by any thread."""
        session = self.session
        if session is None:
            return None
        p50, p99 = self.meter.latency_ms()
        state = session.state()
        return schemas.SessionSummary(
            stream=self.stream,
            profile=state.profile,
            state="stale" if self.stale else state.state,
            rate_hz=self.meter.rate_hz(now_ns),
            latency_p50_ms=p50,
            latency_p99_ms=p99,
            frames=state.frames,
            refused=state.refused,
            shed=self.inbox.shed_frames,
            gaps=state.gaps,
            tracks=state.tracks,
            queue=self.inbox.waiting,
            age_s=self.meter.age_s(now_ns),
        )
