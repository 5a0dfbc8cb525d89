"""Parts: everything of a process that its streams share."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import optipmb_schemas as schemas

from optipmb_service.session.problems import problem_of
from optipmb_service.streams.profiles import Fusion
from optipmb_service.streams.session_factory import SessionFactory

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb
    from optipmb_service.cluster.member import Member
    from optipmb_service.settings import Settings
    from optipmb_service.streams.persistence import CheckpointWriter
    from optipmb_service.streams.profiles import Profiles
    from optipmb_service.streams.recovery import Log
    from optipmb_service.streams.scheduler import Scheduler
    from optipmb_service.streams.traces import Traces
    from optipmb_service.telemetry.metrics import Metrics
    from optipmb_service.telemetry.problem_reporter import ProblemReporter
    from optipmb_service.zenoh.transport import Transport


@dataclass(kw_only=True, eq=False)
class Parts:
    """What all streams of a process share.

    Attributes:
        settings: in force.
        profiles: the parameters that can be had.
        tracker: makes the trackers of sessions.
        transport: opens the publishers of a stream, and asks its caches.
        member: knows which streams are tracked here.
        checkpoints: writes and reads checkpoints.
        log: the log of detections, if there is one.
        scheduler: the tracking thread.
        arm: calls a function at a monotonic time (ns).
        reporter: takes problems.
        metrics: counts messages.
        traces: records spans of frames, where it is asked for.
        keys: of messages on the network.
        limits: of sizes of messages.
        fusion: streams that share sessions.
        sessions: makes and restores sessions.
    """

    settings: Settings
    profiles: Profiles
    tracker: Callable[[optipmb.Parameters], Any]
    transport: Transport
    member: Member
    checkpoints: CheckpointWriter
    log: Log | None
    scheduler: Scheduler
    arm: Callable[[Callable[[], None], int], None]
    reporter: ProblemReporter
    metrics: Metrics
    traces: Traces | None

    def __post_init__(self) -> None:
        self.keys = schemas.Keys(self.settings.prefix)
        self.limits = self.settings.limits.limits()
        self.fusion = Fusion.of(self.settings)
        self.sessions = SessionFactory(self.settings, self.profiles, self.fusion, self.tracker, self.report)

    def report(
        self,
        code: str,
        stream: str,
        expected: str,
        received: str,
        *,
        path: str = "",
        subject: str = "Stream",
        count: int = 1,
    ) -> None:
        """Report a problem that is not of a session.

        Args:
            code: one of the codes of `Problem`.
            stream: the stream it is reported on.
            expected: what would have been accepted.
            received: the value received.
            path: field of the message.
            subject: begins the text; a stream.
            count: number of messages that it concerns.
        """
        texts = {"path": path, "expected": expected, "received": received}
        about = {"stream": stream, "instance": self.settings.instance, "subject": subject}
        problem = problem_of(code, count=count, **about, **texts)
        self.reporter.report(problem, time.monotonic_ns())
