"""What comes out of a stream's session: tracks to their publisher, events to the log, problems to the reporter."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import structlog

from optipmb_service.runtime.track_publisher import TrackPublisher
from optipmb_service.session.problems import problem_of
from optipmb_service.session.values import Begun, Quarantined, Tracked

if TYPE_CHECKING:
    from collections.abc import Sequence

    from optipmb_service.runtime.context import ActorContext
    from optipmb_service.session.session import Session
    from optipmb_service.session.values import Output
    from optipmb_service.telemetry.stream_meter import StreamMeter

log = structlog.get_logger("optipmb_service")


class StreamOutputs:
    """Where the results of one stream go.

    Args:
        stream: the name of the session.
        context: what all actors share.
        meter: the figures of the session, which count every publication.
    """

    def __init__(self, stream: str, context: ActorContext, meter: StreamMeter) -> None:
        self._stream = stream
        self._context = context
        self.tracks = TrackPublisher(stream, context.instance, context.sink, meter, context.metrics, context.member)
        """The publisher of the tracks."""

    def deliver(self, outputs: Sequence[Output], session: Session | None) -> None:
        """Publish, log and report what a session brought.

        Args:
            outputs: what it brought, in order.
            session: the one that is there now.
        """
        for output in outputs:
            if isinstance(output, Tracked):
                self.tracks.send(output)
            elif isinstance(output, Begun):
                epoch = session.state().epoch if session else None
                log.info(
                    "session_begun",
                    stream=self._stream,
                    session=output.session,
                    epoch=epoch.hex() if epoch else "",
                    reason=output.reason,
                    profile=session.parameters.name if session else "",
                    jump_s=output.jump_ns / 1e9,
                )
            elif isinstance(output, Quarantined):
                file = self._context.dump(self._stream, output.dump)
                log.error("session_quarantined", stream=self._stream, error=output.error, file=file)
            else:
                self._context.reporter.report(output, time.monotonic_ns())

    def report(
        self, code: str, path: str, expected: str, received: str, *, what: str = "", count: int = 1, stream: str = ""
    ) -> None:
        """Report a problem that is not of the session.

        Args:
            code: what is wrong, one of the codes of `Problem`.
            path: where in the message.
            expected: what was expected.
            received: what came.
            what: what it is about; a stream.
            count: how many messages it concerns.
            stream: the one that it is said on; that of the session.
        """
        message = f"{what or 'Stream'}: {path or 'message'}: expected {expected}, received {received}."
        problem = problem_of(
            code,
            stream=stream or self._stream,
            instance=self._context.instance,
            path=path,
            expected=expected,
            received=received,
            message=message,
            count=count,
        )
        self._context.reporter.report(problem, time.monotonic_ns())
