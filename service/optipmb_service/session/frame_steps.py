"""What happens when a frame's turn has come: it is put in its place, and the tracker steps.

When a step raises, nothing has changed but that the sensor of the frame is quarantined: the frame and what is held of
the sensor go, unprocessed, and its frames are refused until a reset or a new start of its publisher. What raised is
saved, so that it can be seen again.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from optipmb_service.session.dump import dump_of
from optipmb_service.session.values import MAX_ERROR, SECOND, Quarantined

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

    from optipmb_service.session.fused_timeline import FusedTimeline
    from optipmb_service.session.pending import Held, PendingFrames
    from optipmb_service.session.processed import ProcessedFrames
    from optipmb_service.session.recovery import Recovery
    from optipmb_service.session.reporting import SessionReporting
    from optipmb_service.session.sensor_queues import SensorQueues
    from optipmb_service.session.state import Contents, Entry
    from optipmb_service.session.timeline import FrameId, Timeline
    from optipmb_service.session.values import Output

FLUSH_NS: Final = SECOND
"""Longest time for all frames that are held at a reset, a change of parameters or the end: others wait for them."""


class FrameSteps:
    """Takes frames through the tracker of a session.

    Args:
        processed: what the session has gone through.
        sensors: what is held.
        recovery: what of it is held for caches.
        reporting: says what became of frames.
        run: see `Session.run`.
        clock: measures how long a step takes, ns.
    """

    def __init__(
        self,
        processed: ProcessedFrames,
        sensors: SensorQueues,
        recovery: Recovery,
        reporting: SessionReporting,
        run: int,
        clock: Callable[[], int],
    ) -> None:
        self._processed = processed
        self._sensors = sensors
        self._recovery = recovery
        self._reporting = reporting
        self._clock = clock
        self.has_ready = False
        """Whether frames that may be ready were left."""
        self.run = run
        """See `Session.run`."""

    def accept(self, frame: Held, pending: PendingFrames, now_ns: int) -> list[Output]:
        """Process a frame that arrived, or hold it; returns what became ready by it.

        Args:
            frame: the frame.
            pending: what is held of its sensor.
            now_ns: monotonic time.
        """
        if self._sensors.passes(frame, pending):  # mostly
            self._recovery.now_ns = now_ns
            self.has_ready = False
            return self._process(frame)
        pending.add(frame)
        return self.advance(now_ns)

    def advance(self, now_ns: int | None) -> list[Output]:
        """Process the frames that are ready, in order, `Policy.at_once` of them at most.

        Args:
            now_ns: monotonic time; None: all that are held are ready. All are processed then, within `FLUSH_NS`;
                those left are refused.
        """
        if now_ns is not None:
            self._recovery.now_ns = now_ns
            if (until_ns := self._sensors.recovery_ns) is not None and now_ns >= until_ns:
                self._recovery.end()
        outputs: list[Output] = []
        self.has_ready, taken = False, 0
        ends_ns = self._clock() + FLUSH_NS if now_ns is None else None
        while held := self._sensors.take(now_ns, self._recovery.complete_until):
            outputs += self._process(held)
            taken += 1
            if ends_ns is not None and self._clock() >= ends_ns:
                return [*outputs, *self._refuse_held()]
            if ends_ns is None and taken >= self._sensors.at_once and self._sensors.within_bounds:
                self.has_ready = self._sensors.held > 0
                break
        return outputs

    def amend(self, message: schemas.Points, frame_id: FrameId, ticket: Any) -> list[Output]:
        """Put a cloud that came after its frame into the window."""
        began_ns, placed = self._clock(), self._processed.amended(message, frame_id)
        if placed is None:
            return []
        return self._go(placed, self._processed.timeline, frame_id, ticket, began_ns, None)

    def _process(self, held: Held) -> list[Output]:
        """Put a frame in its place."""
        began_ns, entry = self._clock(), held.entry
        judged_by, decision, timeline = held.judged
        if judged_by is not self._processed.timeline:  # others were held when it came
            decision, timeline = self._processed.timeline.judge(entry.frame_id)
            if not decision.verdict.admitted:
                self._processed.timeline = timeline
                return self._reporting.refused(entry.frame_id, decision)
            entry = replace(entry, place=decision.place)
        contents = held.contents if decision.last else None
        placed = [entry] if decision.last else self._processed.placed(entry, timeline)
        return self._go(placed, timeline, entry.frame_id, held.ticket, began_ns, contents)

    def _go(
        self,
        placed: list[Entry],
        timeline: Timeline | FusedTimeline,
        frame_id: FrameId,
        ticket: Any,
        began_ns: int,
        contents: Contents | None,
    ) -> list[Output]:
        """Go through frames, see `ProcessedFrames.go`; when a step raises, the sensor is quarantined."""
        processed = self._processed
        before = processed.head.session
        try:
            outcomes = processed.go(placed, contents)
        except Exception as error:  # noqa: BLE001 - a fault in one session's step must not end the others
            return self._fail(error, placed if contents is None else [*processed.entries, *placed], frame_id)
        gone = processed.settle(timeline)
        self._sensors.follow(gone)
        self._reporting.deliveries.inserted += contents is None
        session = processed.head.session
        outputs = [] if session == before else self._reporting.begun(outcomes, session)
        took_ns = self._clock() - began_ns
        parameters = processed.transition.parameters
        outputs += self._reporting.tracked(outcomes, parameters, ticket, took_ns, self.run)
        return outputs

    def _refuse_held(self) -> list[Output]:
        """Refuse all frames that are held, with a problem for each sensor."""
        problems: list[Output] = []
        for one in self._sensors.pending.values():
            if (first := one.first) is not None:
                count = one.clear()
                self._reporting.deliveries.refused += count
                problems.append(self._reporting.complain.too_slow(first, count, FLUSH_NS))
        self._sensors.follow()
        return problems

    def _fail(self, error: Exception, placed: list[Entry], frame_id: FrameId) -> list[Output]:
        """Take no more frames of the sensor; the one that failed and what is held go, unprocessed."""
        reason = self._sensors.quarantine[frame_id.sensor] = f"{type(error).__name__}: {error}"[:MAX_ERROR]
        came = len(placed) - len(self._processed.entries)  # none with a late cloud, whose numbers are no frame's
        self._reporting.deliveries.refused += came + self._sensors.pending[frame_id.sensor].clear()
        if came:
            self._processed.note(frame_id)
        self._sensors.follow()
        dump = dump_of(self._processed.transition, self._processed.base, placed, error)
        return [self._reporting.complain.failed(frame_id, reason), Quarantined(reason, dump)]
