"""Parts: everything of a process that its streams share."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from optipmb_service.session.problems import problem_of

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

    from optipmb_service.cluster.member import Member
    from optipmb_service.session.identity import Incarnation
    from optipmb_service.settings import Settings
    from optipmb_service.streams.admission import Admission
    from optipmb_service.streams.directory import StreamDirectory
    from optipmb_service.streams.persistence import CheckpointWriter
    from optipmb_service.streams.profiles import Fusion
    from optipmb_service.streams.recovery import Log
    from optipmb_service.streams.session_factory import SessionFactory
    from optipmb_service.streams.stream import Stream
    from optipmb_service.streams.traces import Traces
    from optipmb_service.telemetry.metrics import Metrics
    from optipmb_service.telemetry.problem_reporter import ProblemReporter
    from optipmb_service.zenoh.inputs import Packet
    from optipmb_service.zenoh.transport import StreamPublisher


@dataclass(frozen=True)
class Parts:
    """What all streams of a process share; made by `Streams`.

    Attributes:
        settings: in force.
        keys: of messages on the network.
        limits: of sizes of messages.
        fusion: streams that share sessions.
        sessions: makes and restores sessions.
        admission: room for sessions.
        directory: streams that are known.
        member: knows which streams are tracked here.
        checkpoints: writes and reads checkpoints.
        log: the log of detections, if there is one.
        reporter: takes problems.
        metrics: counts messages.
        traces: records spans of frames, where it is asked for.
        open_publisher: opens the publishers of a stream (`Transport.open_publisher`).
        ask_cache: asks the caches of a stream (`Transport.ask_cache`).
        submit: has the tracking thread do a piece of work (`Scheduler.submit`).
        arm: calls a function at a monotonic time (ns).
        admit: counts a session that begins (`Streams.admit`).
        discard: forgets a stream that has ended (`Streams.discard`).
    """

    settings: Settings
    keys: schemas.Keys
    limits: schemas.Limits
    fusion: Fusion
    sessions: SessionFactory
    admission: Admission
    directory: StreamDirectory
    member: Member
    checkpoints: CheckpointWriter
    log: Log | None
    reporter: ProblemReporter
    metrics: Metrics
    traces: Traces | None
    open_publisher: Callable[..., StreamPublisher]
    ask_cache: Callable[[str, Callable[[list[Packet], bool], None]], None]
    submit: Callable[[Callable[[], bool]], None]
    arm: Callable[[Callable[[], None], int], None]
    admit: Callable[[str], Incarnation | None]
    discard: Callable[[Stream], None]

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
