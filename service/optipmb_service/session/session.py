"""One session: what decides about a stream's messages. No I/O, no threads, no clock of its own.

Conventions: `now_ns` is the local monotonic clock, handed in by the caller and used for nothing but waiting, for point
clouds and, after a restore, for frames that were missed; everything else follows from the messages. So the same
messages give the same tracks, byte for byte, and those of the window give the same state in whatever order they come.

The parts: `pending` holds frames until they are ready, `processed` has those that were gone through, `reporting` says
and counts what became of them. Here are commands, the state to be written down, and what is done when a step fails.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import optipmb
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import Checkpoint
from optipmb_service.session.dump import dump_of
from optipmb_service.session.pending import PendingFrames
from optipmb_service.session.processed import ProcessedFrames
from optipmb_service.session.reporting import SessionReporting
from optipmb_service.session.state import Entry, FilterState, PoseHistory
from optipmb_service.session.timeline import FrameId, Timeline
from optipmb_service.session.transition import Transition
from optipmb_service.session.values import (
    MAX_CLOUD_WAIT_NS,
    MAX_ERROR,
    SECOND,
    Begun,
    Counters,
    Lineage,
    Output,
    Policy,
    Quarantined,
    RefusedError,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.session.pending import Ready
    from optipmb_service.session.reporting import Condition
    from optipmb_service.session.values import Steps


class Session:
    """The state of one stream.

    Args:
        stream: `site/node/sensor`.
        parameters: the profile to track with.
        policy: waiting, restarting, going back.
        instance: name of the service, for problems.
        life: what an earlier session of the stream left behind.
        tracker: makes the tracker; tests put their own here.
        clock: measures how long a step takes, ns.
    """

    def __init__(
        self,
        stream: str,
        parameters: optipmb.Parameters,
        policy: Policy | None = None,
        *,
        instance: str = "session",
        life: Lineage | None = None,
        tracker: Callable[[optipmb.Parameters], Steps] = optipmb.Tracker,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self.stream = stream
        self._policy = policy or Policy()
        self._cloud_wait_ns: int | None = None
        self._reporting = SessionReporting(stream, instance, self._policy)
        self._clock = clock
        self._make = tracker
        self._processed = ProcessedFrames(self._transition(parameters), self._policy, life or Lineage())
        self._pending = PendingFrames(self._policy, self._processed.timeline)
        self._quarantine = ""
        self._run = 0

    # What arrives

    def on_detections(
        self, message: schemas.Detections, now_ns: int, *, arrived_ns: int | None = None, ticket: Any = None
    ) -> list[Output]:
        """Take a frame; returns what became ready by it, which may be nothing, this frame or frames held before it.

        Args:
            message: the frame.
            now_ns: monotonic time.
            arrived_ns: when the frame arrived, if before now: its wait for a cloud began then.
            ticket: comes back with the tracks of the frame, and with those that it corrects.
        """
        frame_id = FrameId(message.epoch, message.seq, message.stamp_ns)
        outputs: list[Output] = []
        if self._quarantine:
            if self._processed.timeline.knows(frame_id.epoch):
                self._reporting.deliveries.refused += 1
                return [self._reporting.complain.quarantined(frame_id, self._quarantine)]
            outputs += self.reset("quarantine")
        judged_by = self._pending.timeline
        decision, arrived = judged_by.judge(frame_id)
        if not decision.verdict.admitted:
            return [*outputs, *self._reporting.refused(frame_id, decision)]
        try:
            frame, ignored = convert.frame_of(self.parameters, message)
        except optipmb.FrameError as error:
            self._reporting.deliveries.refused += 1
            self._processed.note(frame_id)
            self._pending.timeline = self._pending.timeline.note(frame_id)
            return [*outputs, self._reporting.complain.invalid(frame_id, error)]
        self._pending.timeline = arrived
        since_ns = now_ns if arrived_ns is None else arrived_ns
        judged = judged_by, decision, arrived
        self._pending.add(message, frame_id, frame, ignored, since_ns, ticket, judged)
        return [*outputs, *self._advance(now_ns)]

    def on_points(self, message: schemas.Points, now_ns: int, *, ticket: Any = None) -> list[Output]:
        """Take a cloud; returns what waited for it and, by setting, what it corrects.

        Args:
            message: the cloud.
            now_ns: monotonic time.
            ticket: comes back with the tracks that the cloud corrects.
        """
        try:
            convert.cloud_of(message)
        except optipmb.FrameError as error:
            return [self._reporting.complain.invalid(FrameId(message.epoch, message.seq, message.stamp_ns), error)]
        self._pending.clouds.add(message)
        outputs = self._amend(message, ticket) if self._policy.late_clouds and not self._quarantine else []
        return [*outputs, *self._advance(now_ns)]

    def on_tick(self, now_ns: int) -> list[Output]:
        """Return what need not wait any longer."""
        return self._advance(now_ns)

    @property
    def deadline_ns(self) -> int | None:
        """When `on_tick` is due (monotonic, ns); None while nothing is held."""
        return self._pending.deadline_ns(self._processed.complete_until)

    def refuse(self) -> None:
        """Count a message of the stream that was none."""
        self._reporting.deliveries.refused += 1

    # Commands

    def flush(self) -> list[Output]:
        """Process what is held, without waiting any longer."""
        return self._advance(None)

    def reset(self, reason: str = "reset") -> list[Output]:
        """Forget the density and begin anew; frames seen before stay seen, track ids go on, a quarantine ends."""
        outputs = self.flush()
        self._quarantine = ""
        head, starts = self._processed.head, self._processed.head.starts + 1
        self._begin(
            replace(
                head,
                density=optipmb.Density.empty(self._processed.transition.parameters.labels, head.density.next_id),
                session=self._processed.transition.name(head.last, starts),
                starts=starts,
                tracks=0,
                reported=frozenset(),
                pose_history=PoseHistory(),
            )
        )
        return [*outputs, Begun(self.session, reason)]

    def configure(
        self,
        parameters: optipmb.Parameters | None,
        cloud_wait_s: float | None,
        horizons: Sequence[float] | None = None,
        *,
        restart: bool,
    ) -> list[Output]:
        """Change what a session runs with; another profile only before the first frame or with `restart`.

        Args:
            parameters: the profile; None: as before.
            cloud_wait_s: the longest wait for a cloud; None: as before.
            horizons: those of predicted paths, valid ones; None: those of the profile that is set, else as before.
            restart: whether the session may begin anew.

        Raises:
            RefusedError: another profile, frames were processed, and no restart was asked for; or too long a wait.
        """
        if cloud_wait_s is not None and cloud_wait_s * SECOND > MAX_CLOUD_WAIT_NS:
            longest = f"at most {MAX_CLOUD_WAIT_NS / SECOND:g} seconds"
            raise RefusedError("cloud_wait_s", longest, f"{cloud_wait_s:g}")
        before = self.parameters
        wanted = parameters or before
        if horizons is not None:
            wanted = wanted.model_copy(update={"horizons": tuple(horizons)})
        changes = wanted.model_copy(update={"horizons": before.horizons}) != before
        if changes and not restart and self.counters.frames:
            raise RefusedError(
                "profile",
                f"{self.parameters.name!r}, or restart = true: {self.counters.frames} frames have been tracked with it",
                repr(wanted.name),
            )
        outputs = self.flush() if changes else []
        if cloud_wait_s is not None:
            self._wait(round(cloud_wait_s * SECOND))
        if changes:
            # Frames are given to the tracker by the classes of the old profile: they cannot be gone over again.
            self._begin(self._processed.head, self._transition(wanted))
        elif wanted != before:
            self._processed.report_by(self._transition(wanted))
        if restart:
            outputs += self.reset("parameters")
        elif changes:
            head = self._processed.head
            # What was begun with the old profile has its classes.
            empty = optipmb.Density.empty(self._processed.transition.parameters.labels, head.density.next_id)
            self._begin(replace(head, session=self._processed.transition.name(None, head.starts), density=empty))
        return outputs

    # To be written down and taken up again

    def snapshot(self) -> Checkpoint:
        """Return the state between two frames, without those held, which come again from the publisher's cache.

        It refers to values that never change: cheap, to be encoded later.
        """
        base, window = self._processed.portable()
        return Checkpoint(
            stream=self.stream,
            parameters=self.parameters,
            cloud_wait_ns=self._cloud_wait_ns,
            quarantine=self._quarantine,
            epochs=self._processed.timeline.epochs,
            base=base,
            window=window,
            head=self._processed.head,
            deliveries=replace(self._reporting.deliveries),
            newest_cloud_ns=self._pending.clouds.newest_ns,
            run=self._run,
        )

    @classmethod
    def restore(
        cls,
        checkpoint: Checkpoint,
        now_ns: int,
        policy: Policy | None = None,
        *,
        instance: str = "session",
        tracker: Callable[[optipmb.Parameters], Steps] = optipmb.Tracker,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> Self:
        """Return the session that a checkpoint was taken of. It is `recovering` for a while.

        Its tracks belong to another `run`, so the caller should write it down again before it publishes any: two runs
        from one checkpoint would have the same number.

        Args:
            checkpoint: its state; its profile goes on too.
            now_ns: monotonic time; the waiting for missed frames begins now.
            policy: waiting, restarting, going back.
            instance: name of the service, for problems.
            tracker: makes the tracker.
            clock: measures how long a step takes, ns.

        Raises:
            CheckpointError: its frames do not fit together.
        """
        session = cls(checkpoint.stream, checkpoint.parameters, policy, instance=instance, tracker=tracker, clock=clock)
        session._resume(checkpoint, now_ns)
        return session

    @property
    def recovering(self) -> bool:
        """Whether frames behind a gap are held, because those missing may still come from the publisher's cache."""
        return self._pending.recovery_ns is not None

    def recovered(self, now_ns: int) -> list[Output]:
        """End the waiting: all that the caches have is here. Returns what was held for it."""
        self._pending.recovery_ns = None
        return self._advance(now_ns)

    # What it is

    @property
    def parameters(self) -> optipmb.Parameters:
        """The profile."""
        return self._processed.transition.parameters

    @property
    def session(self) -> str:
        """The id of the present life of the density."""
        return self._processed.head.session

    @property
    def density(self) -> optipmb.Density:
        """The density after the last frame."""
        return self._processed.head.density

    @property
    def counters(self) -> Counters:
        """What happened to the messages so far."""
        return self._reporting.counters(self._processed.head)

    @property
    def run(self) -> int:
        """How often the session was taken up again.

        A frame that was tracked before a crash, with others missing, may be tracked again after it with these there,
        and nobody knows any more under which revision it was published. What a later run publishes of a frame holds.
        """
        return self._run

    @property
    def held_bytes(self) -> int:
        """Bytes of the messages that are kept: frames that wait, clouds, and the window; nearly, for any thread."""
        window = sum(entry.weight for entry in self._processed.entries)
        return window + self._pending.held_bytes + self._pending.clouds.bytes

    @property
    def quarantine(self) -> str:
        """The error for which frames are refused; empty while they are not."""
        return self._quarantine

    @property
    def cloud_wait_s(self) -> float:
        """The longest wait for a cloud."""
        return self._policy.cloud_wait_ns / SECOND

    @property
    def life(self) -> Lineage:
        """What a later session of the stream has to know."""
        head = self._processed.head
        return Lineage(head.starts, head.density.next_id)

    def state(self, *, shed: int = 0, queue: int = 0, closed: bool = False) -> schemas.SessionState:
        """Return the state as the message that answers a query."""
        return self._reporting.state(
            self.parameters.name,
            self._processed.head,
            condition="closed" if closed else self._condition,
            shed=shed,
            queue=queue + len(self._pending),
        )

    @property
    def _condition(self) -> Condition:
        if self._quarantine:
            return "quarantined"
        if self.recovering:
            return "recovering"
        return "running" if self.counters.frames else "new"

    # The order of things

    def _advance(self, now_ns: int | None) -> list[Output]:
        """Process the frames that are ready, in order; None: all of them."""
        outputs: list[Output] = []
        while ready := self._pending.take(now_ns, self._processed.complete_until):
            outputs += self._process(ready)
        return outputs

    def _process(self, ready: Ready) -> list[Output]:
        """Put a frame in its place."""
        began_ns, frame_id = self._clock(), ready.held.frame_id
        judged_by, decision, timeline = ready.held.judged
        if judged_by is not self._processed.timeline:  # others were held when it came
            decision, timeline = self._processed.timeline.judge(frame_id)
        if not decision.verdict.admitted:
            return self._reporting.refused(frame_id, decision)
        placed = self._processed.placed(ready, decision, timeline)
        return self._go(placed, timeline, frame_id, ready.held.ticket, began_ns, behind=decision.last)

    def _amend(self, message: schemas.Points, ticket: Any) -> list[Output]:
        """Put a cloud that came after its frame into the window."""
        began_ns, frame_id = self._clock(), FrameId(message.epoch, message.seq, message.stamp_ns)
        placed = self._processed.amended(message)
        return (
            []
            if placed is None
            else self._go(placed, self._processed.timeline, frame_id, ticket, began_ns, behind=False)
        )

    def _go(
        self, placed: list[Entry], timeline: Timeline, frame_id: FrameId, ticket: Any, began_ns: int, *, behind: bool
    ) -> list[Output]:
        """Go through frames with what is new among them; when a step raises, the session is quarantined as it was."""
        before = self.session
        try:
            outcomes = self._processed.go(placed, behind=behind)
        except Exception as error:  # noqa: BLE001 - a fault in one session's step must not end the others
            return self._fail(error, placed, frame_id)
        gone = self._processed.settle(timeline)
        self._pending.follow(self._processed.timeline, self._processed.base, gone)
        self._reporting.deliveries.inserted += not behind
        begun = self._reporting.begun(outcomes, before, self.session)
        took_ns = self._clock() - began_ns
        return [*begun, *self._reporting.tracked(outcomes, self.parameters, ticket, took_ns, self._run)]

    def _fail(self, error: Exception, placed: list[Entry], frame_id: FrameId) -> list[Output]:
        """Take no more frames; the one that failed and what is held go, unprocessed."""
        self._quarantine = f"{type(error).__name__}: {error}"[:MAX_ERROR]
        self._reporting.deliveries.refused += 1 + self._pending.clear()
        self._processed.note(frame_id)
        self._pending.timeline = self._processed.timeline
        dump = dump_of(self._processed.transition, self._processed.base, placed, error)
        return [self._reporting.complain.failed(frame_id, self._quarantine), Quarantined(self._quarantine, dump)]

    def _begin(self, state: FilterState, transition: Transition | None = None) -> None:
        """Go on from a moment without a way back behind it."""
        self._processed.begin(state, transition)
        self._pending.timeline = self._processed.timeline

    def _resume(self, checkpoint: Checkpoint, now_ns: int) -> None:
        if checkpoint.cloud_wait_ns is not None:
            self._wait(checkpoint.cloud_wait_ns)
        self._quarantine = checkpoint.quarantine
        self._reporting.deliveries = replace(checkpoint.deliveries)
        self._pending.clouds.newest_ns = checkpoint.newest_cloud_ns
        self._pending.recovery_ns = now_ns + self._policy.recovery_wait_ns
        self._run = checkpoint.run + 1
        self._processed.resume(checkpoint)
        self._pending.timeline = self._processed.timeline

    def _wait(self, cloud_wait_ns: int) -> None:
        self._cloud_wait_ns = cloud_wait_ns
        self._policy = self._pending.policy = replace(self._policy, cloud_wait_ns=cloud_wait_ns)

    def _transition(self, parameters: optipmb.Parameters) -> Transition:
        return Transition(self.stream, parameters, self._make(parameters), self._policy)
