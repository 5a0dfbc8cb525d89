"""A service on the network: every part of it, put together, started and ended in order.

Messages go from a thread of the network to a stream's backlog to the tracking thread.

Start: open Zenoh, subscribe, answer queries, say alive. End: withdraw the alive token, let other members take the
streams over, stop receiving, track waiting messages as long as the grace lasts, close.
"""

from __future__ import annotations

import math
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog
from optipmb_client.errors import ConnectionFailed as TransportError

import optipmb
from optipmb_service import __version__
from optipmb_service.app.lifecycle import CLOSE_S, HANDOVER_S, LAST_S, Deadline, Steps
from optipmb_service.app.storage import open_log, open_store
from optipmb_service.cluster.member import Member
from optipmb_service.session.problems import problem_of
from optipmb_service.streams.intake import Intake
from optipmb_service.streams.kept_tracks import TrackQuery
from optipmb_service.streams.parts import Parts
from optipmb_service.streams.persistence import CheckpointWriter
from optipmb_service.streams.queries import ServiceQueries, StreamQueries, members_of
from optipmb_service.streams.scheduler import Scheduler
from optipmb_service.streams.streams import Streams
from optipmb_service.telemetry.health import Component
from optipmb_service.telemetry.metrics import (
    NETWORK_METRICS,
    PROBLEM_METRICS,
    STREAM_METRICS,
    Metrics,
    StreamFigures,
)
from optipmb_service.telemetry.problem_reporter import ProblemReporter
from optipmb_service.units import DAY_S, SECOND
from optipmb_service.zenoh.transport import Transport

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from optipmb_service.settings import Settings
    from optipmb_service.streams.profiles import Profiles
    from optipmb_service.zenoh.client import Client

log = structlog.get_logger("optipmb_service")

DRAIN_POLL_S: Final = 0.01
JOIN_S: Final = 0.3
SAVE_S: Final = 0.5  # the last checkpoints have so long even where messages took all the time
NAME_CHECK_NS: Final = 10 * SECOND  # how often another process of the same name is looked for
TRACES_S: Final = 1.0  # for sending the last spans
LEASES_S: Final = 1.0  # kept for releasing the leases, however long the checkpoints take


class Service(Component):
    """A service on the network, without signals or a loop of its own: `run` adds these, tests use it as it is.

    Args:
        settings: of the process.
        profiles: the parameters that can be had.
        arm: calls a function at a monotonic time (ns).
        tracker: makes the trackers of sessions; default: trackers bounded as the settings say.
        private: folder that the workers of one parent share; default: this process has no parent.
        metrics: what counts; its own by default.

    Raises:
        TransportError: the network cannot be used.
        StoreError: the store cannot be used, and others use it.
    """

    def __init__(
        self,
        settings: Settings,
        profiles: Profiles,
        arm: Callable[[Callable[[], None], int], None],
        tracker: Callable[[optipmb.Parameters], Any] | None = None,
        private: Path | None = None,
        metrics: Metrics | None = None,
    ) -> None:
        self._settings = settings
        self._started_ns = time.time_ns()
        self._began_ns = time.monotonic_ns()
        self._name_checked_ns = 0
        self._state = "starting"
        self._metrics = metrics or Metrics()
        store, keeps_nothing = open_store(settings, private)
        try:
            self._transport = Transport(settings)
        except TransportError:
            store.close(JOIN_S)
            raise
        super().__init__(self.client())
        self._reporter = ProblemReporter(self.client().publish_problem)
        self._scheduler = Scheduler()
        self._member = Member(settings.instance, store, settings.lease_s)
        self._checkpoints = CheckpointWriter(
            store, settings.checkpoint_s, self._member, self._unkept, settings.keep_days * DAY_S, keeps_nothing
        )
        self._log = open_log(settings)
        self._traces: Traces | None = None
        if settings.traces:
            from optipmb_service.streams.traces import Traces  # noqa: PLC0415 - an extra that only this needs

            self._traces = Traces(settings.instance)
        self._streams = Streams(
            Parts(
                settings=settings,
                profiles=profiles,
                tracker=tracker or profiles.trackers(partial(optipmb.Tracker, max_pairs=settings.max_pairs)),
                transport=self._transport,
                member=self._member,
                checkpoints=self._checkpoints,
                log=self._log,
                scheduler=self._scheduler,
                arm=arm,
                reporter=self._reporter,
                metrics=self._metrics,
                traces=self._traces,
            )
        )
        self._intake = Intake(
            self._streams,
            self._member,
            self._transport,
            standby=not settings.cluster,
            linger_s=settings.lease_s,
        )
        self._metrics.add(PROBLEM_METRICS | STREAM_METRICS, self._figures)
        self._metrics.add(NETWORK_METRICS, self.client)
        tracks = TrackQuery(self._log, self._transport.recent_tracks, settings.instance, settings.limits.limits())
        self._stream_queries = StreamQueries(self._streams, tracks)
        self._service_queries = ServiceQueries(
            self._streams,
            status=self.status,
            metrics=self._metrics.text,
            hand_over=self._intake.hand_over,
            workers=settings.workers,
        )

    def start(self, *, announce: bool = True) -> None:
        """Receive, answer, and say so."""
        self._transport.watch()
        self._checkpoints.start(self._streams.keep, self._streams.kept)
        self._member.start(self._intake.changed, self._streams.resume, self._streams.occupied, self.client().linked)
        self._intake.start()
        self._transport.serve(self._stream_queries.answer, self._service_queries.answer)
        self._state = "ready"
        if announce:
            self._transport.announce()

    def housekeeping(self) -> None:
        """Report silent streams and summaries of problems; to be called about once a second."""
        now_ns = time.monotonic_ns()
        self._streams.sweep(now_ns)
        self._transport.look_for_returned(self._report_returned)
        if now_ns >= self._name_checked_ns:
            self._name_checked_ns = now_ns + NAME_CHECK_NS
            self._transport.find_duplicate_name(self._report_duplicate_name)
        self._reporter.flush(now_ns)

    def stop(self, seconds: float = math.inf) -> bool:
        """Hand the streams over, track waiting messages within the grace, and close.

        Every step is bounded in time except the last, closing the network; all checkpoints are written before that.

        Args:
            seconds: time for all steps.

        Returns:
            False when a step would not end, or not all checkpoints are written.
        """
        self._state = "stopping"
        grace_s = self._settings.grace_s
        ends = Deadline(min(HANDOVER_S + grace_s + CLOSE_S, seconds - LAST_S))
        steps = Steps()
        steps.do("leaving", self._transport.leave)
        self._member.drain()
        self._member.drained(max(0.0, ends.left() - grace_s - CLOSE_S))
        self._intake.handed_over(JOIN_S)
        grace = Deadline(grace_s)
        self._intake.close(JOIN_S)
        steps.do("receiving", partial(self._transport.stop, JOIN_S))
        if not self._checkpoints.durable:
            self._streams.finish()  # else what waits for its cloud comes again from the publishers' caches
        while self._streams.busy and grace.left():
            time.sleep(DRAIN_POLL_S)
        ended = self._scheduler.close(max(JOIN_S, ends.left() - SAVE_S - LEASES_S))
        if ended:
            self._streams.keep_now()
        else:
            log.error("step_hangs", steps=["tracking"])
        kept = self._checkpoints.close(max(SAVE_S, ends.left() - LEASES_S))
        self._member.close(ends.left())
        if self._log is not None:
            self._log.close(JOIN_S)
        if self._traces is not None:
            self._traces.close(min(TRACES_S, ends.left()))
        self._reporter.flush(time.monotonic_ns())
        unfinished = steps.unfinished(ends.left())
        self._transport.close()
        return ended and kept and not unfinished

    @property
    def stuck(self) -> bool:
        """Whether the tracking thread has been at one piece of work for too long."""
        return self._scheduler.busy_s > self._settings.stuck_s

    @property
    def failure(self) -> str:
        """Why the state is `degraded`, `paused` or `unlinked`; empty while it is none of these."""
        return self._member.failure or self.client().failure or self._checkpoints.failure

    @property
    def state(self) -> str:
        """What the service is: starting, ready, degraded, paused, unlinked, draining or stopping.

        Degraded: it tracks, and cannot keep checkpoints. Paused: it may not publish, for it has no lease. Unlinked: it
        has no router. Draining: it leaves its streams to others, or has.
        """
        if self._state != "ready":
            return self._state
        if self._member.failure:
            return "paused"
        if self.client().failure:
            return "unlinked"
        if self._member.draining:
            return "draining"
        return "degraded" if self._checkpoints.failure else "ready"

    def status(self) -> schemas.ServiceStatus:
        """Return the answer to `q/status`."""
        now_ns = time.monotonic_ns()
        totals = self._streams.totals()
        return schemas.ServiceStatus(
            instance=self._settings.instance,
            version=__version__,
            started_ns=self._started_ns,
            uptime_s=(now_ns - self._began_ns) / 1e9,
            state=self.state,
            sessions=self._summaries(now_ns),
            standby=self._intake.standing_by,
            members=members_of(self._member.leases()),
            received=totals.received,
            frames=totals.frames,
            duplicates=totals.duplicates,
            late=totals.late,
            refused=totals.refused,
            shed=totals.shed,
            clouds_refused=totals.clouds_refused,
            problems=self._reporter.newest(),
        )

    def detections_of(self, stream: str) -> str:
        """Return the pattern of the streams whose detections belong to the tracks of a stream."""
        return self._streams.parts.fusion.seen_by(stream)

    def client(self) -> Client:
        """Return what an edge in this process uses of the network."""
        return self._transport.client()

    def _summaries(self, now_ns: int) -> tuple[schemas.SessionSummary, ...]:
        """Return a line for each session; one that cannot be made is a problem of its stream alone."""
        summaries = []
        for stream in self._streams.tracking():
            try:
                summary = stream.summary(now_ns)
            except Exception as error:
                log.exception("internal_error", stream=stream.name)
                expected, received = "the line of a session in the status", f"{type(error).__name__}: {error}"
                self._report("internal", stream=stream.name, expected=expected, received=received)
            else:
                summaries += [summary] if summary is not None else []
        return tuple(summaries)

    def report_certificate(self, why: str) -> None:
        self._report("certificate", expected="certificates that hold", received=why, message=why)

    def _report_returned(self, token: str, due: int, newest: int) -> None:
        expected, received = f"messages numbered from {due} on by Zenoh", f"numbers that began again, now {newest}"
        message = f"Publisher: expected {expected}, received {received}; remove `id` from its Zenoh configuration."
        stream = schemas.Keys(self._settings.prefix).stream_of(token)
        self._report("numbers_back", stream=stream, expected=expected, received=received, message=message)

    def _report_duplicate_name(self) -> None:
        name, expected = self._settings.instance, "a name that no other process has"
        message = f"Setting instance: another process is named {name}, too; give each a name of its own."
        self._report("duplicate_name", path="instance", expected=expected, received=name, message=message)

    def _unkept(self, stream: str, why: str) -> None:
        self._report("internal", stream=stream, expected="a state that can be written down", received=why)

    def _report(self, code: str, *, stream: str = "", **texts: str) -> None:
        problem = problem_of(code, subject="Stream", stream=stream, instance=self._settings.instance, **texts)
        self._reporter.report(problem, time.monotonic_ns())

    def _figures(self) -> StreamFigures:
        now_ns = time.monotonic_ns()
        sessions, complete_ns = self._summaries(now_ns), self._checkpoints.complete_ns
        return StreamFigures(
            self._reporter,
            self._streams.totals(),
            sessions,
            sessions[: self._settings.http_streams],
            [session.density for one in self._streams.tracking() if (session := one.session) is not None],
            standing_by=self._intake.standing_by,
            checkpoints=self._checkpoints.written,
            checkpoint_age_s=None if complete_ns is None else max(0, now_ns - complete_ns) / SECOND,
        )
