"""One session: what decides about a stream's messages. No I/O, no threads, no clock of its own.

Conventions: `now_ns` is the local monotonic clock, handed in by the caller and used for nothing but waiting, for point
clouds and, after a restore, for frames that were missed; everything else follows from the messages. So the same
messages give the same tracks, byte for byte, and those of the window give the same state in whatever order they come.

The parts: `timing` says where a frame belongs, `waiting` holds frames until they are ready, `history` holds the window
and goes over it again when it must, `stepping` takes one frame through the tracker. What is here is what happens around
them: commands, the state to be written down, and what is done when a step fails.
"""

from __future__ import annotations

import time
import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Self

import optipmb
from optipmb_service import convert
from optipmb_service.checkpoint import Checkpoint, Recorded
from optipmb_service.clouds import Clouds
from optipmb_service.complaints import Complaints
from optipmb_service.history import History
from optipmb_service.moments import Entry, Moment, Whereabouts, weigh
from optipmb_service.quarantine import dump_of
from optipmb_service.records import (
    SECOND,
    Begun,
    Counters,
    Deliveries,
    Life,
    Output,
    Policy,
    Quarantined,
    RefusedError,
    Tracked,
)
from optipmb_service.stepping import Outcome, Stepper, empty
from optipmb_service.telling import counters_of, state_of
from optipmb_service.timing import Decision, Mark, Timeline, Verdict, hold_until
from optipmb_service.waiting import Held, Waiting
from optipmb_service.window import window_of

if TYPE_CHECKING:
    from collections.abc import Callable

    import optipmb_schemas as schemas

    from optipmb_service.history import Step
    from optipmb_service.records import Steps
    from optipmb_service.telling import Condition
    from optipmb_service.waiting import Ready

MAX_ERROR: Final = 400
"""Characters kept of an error."""


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
        life: Life | None = None,
        tracker: Callable[[optipmb.Parameters], Steps] = optipmb.Tracker,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self.stream = stream
        self._deliveries = Deliveries()
        self._policy = policy or Policy()
        self._cloud_wait_ns: int | None = None
        self._complain = Complaints(stream, instance)
        self._clock = clock
        self._make = tracker
        self._stepper = Stepper(stream, parameters, tracker(parameters))
        life = life or Life()
        self._history = History(empty(self._stepper, None, life.next_id, life.starts), _weakly(self._step))
        self._done = Timeline(self._policy.gap_limit_ns)
        self._arrived = self._done
        self._waiting = Waiting()
        self._clouds = Clouds(self._policy.clouds)
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
        mark = Mark(message.epoch, message.seq, message.stamp_ns)
        outputs: list[Output] = []
        if self._quarantine:
            if self._done.knows(mark.epoch):
                self._deliveries.refused += 1
                return [self._complain.quarantined(mark, self._quarantine)]
            outputs += self.reset("quarantine")
        decision, arrived = self._arrived.judge(mark)
        if not decision.verdict.admitted:
            return [*outputs, *self._refuse(mark, decision)]
        try:
            frame, ignored = convert.frame_of(self.parameters, message)
        except optipmb.FrameError as error:
            self._deliveries.refused += 1
            self._done, self._arrived = self._done.note(mark), self._arrived.note(mark)
            return [*outputs, self._complain.invalid(mark, error)]
        self._arrived = arrived
        deadline_ns = hold_until(
            has_points=message.has_points,
            stamp_ns=mark.stamp_ns,
            arrived_ns=now_ns if arrived_ns is None else arrived_ns,
            newest_cloud_ns=self._clouds.newest_ns,
            cloud_wait_ns=self._policy.cloud_wait_ns,
            cloud_memory_ns=self._policy.cloud_memory_ns,
        )
        self._waiting.add(Held(message, mark, decision.place.order(mark), frame, ignored, deadline_ns, ticket))
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
            return [self._complain.invalid(Mark(message.epoch, message.seq, message.stamp_ns), error)]
        self._clouds.add(message)
        outputs = self._amend(message, ticket) if self._policy.late_clouds and not self._quarantine else []
        return [*outputs, *self._advance(now_ns)]

    def on_tick(self, now_ns: int) -> list[Output]:
        """Return what need not wait any longer."""
        return self._advance(now_ns)

    @property
    def deadline_ns(self) -> int | None:
        """When `on_tick` is due (monotonic, ns); None while nothing is held."""
        return self._waiting.deadline_ns(self._complete)

    @property
    def held(self) -> int:
        """Frames waiting, for their clouds or for frames that were missed."""
        return len(self._waiting)

    def refuse(self) -> None:
        """Count a message of the stream that was none."""
        self._deliveries.refused += 1

    # Commands

    def flush(self) -> list[Output]:
        """Process what is held, without waiting any longer."""
        return self._advance(None)

    def reset(self, reason: str = "reset") -> list[Output]:
        """Forget the density and begin anew; frames seen before stay seen, track ids go on, a quarantine ends."""
        outputs = self.flush()
        self._quarantine = ""
        head = self._history.head
        starts = head.starts + 1
        self._begin(
            replace(
                head,
                density=optipmb.Density.empty(head.density.next_id),
                session=self._stepper.name(head.last, starts),
                starts=starts,
                tracks=0,
                reported=frozenset(),
                whereabouts=Whereabouts(),
            )
        )
        return [*outputs, Begun(self.session, reason)]

    def configure(
        self, parameters: optipmb.Parameters | None, cloud_wait_s: float | None, *, restart: bool
    ) -> list[Output]:
        """Change what a session runs with; another profile only before the first frame or with `restart`.

        Raises:
            RefusedError: another profile, frames were processed, and no restart was asked for.
        """
        changes = parameters is not None and parameters != self.parameters
        if changes and not restart and self.counters.frames:
            raise RefusedError(
                "profile",
                f"{self.parameters.name!r}, or restart = true: {self.counters.frames} frames have been tracked with it",
                repr(parameters.name if parameters else ""),
            )
        outputs = self.flush() if changes else []
        if cloud_wait_s is not None:
            self._wait(round(cloud_wait_s * SECOND))
        if parameters is not None and changes:
            # Frames are given to the tracker by the classes of the old profile: they cannot be gone over again.
            self._begin(self._history.head)
            self._stepper = Stepper(self.stream, parameters, self._make(parameters))
        if restart:
            outputs += self.reset("parameters")
        elif changes:
            head = self._history.head
            self._begin(replace(head, session=self._stepper.name(None, head.starts)))
        return outputs

    # To be written down and taken up again

    def snapshot(self) -> Checkpoint:
        """Return the state between two frames, as references to values that never change: cheap, to be encoded later.

        Frames that are held are not in it: they come again from the publisher's cache.
        """
        base, entries = self._history.portable(self._policy.checkpoint_bytes)
        return Checkpoint(
            stream=self.stream,
            parameters=self.parameters,
            cloud_wait_ns=self._cloud_wait_ns,
            quarantine=self._quarantine,
            epochs=self._done.epochs,
            base=base,
            window=tuple(Recorded(one.message, one.points, one.missed, one.revision, one.packed) for one in entries),
            head=self._history.head,
            deliveries=replace(self._deliveries),
            newest_cloud_ns=self._clouds.newest_ns,
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
        return self._waiting.recovery_ns is not None

    def recovered(self, now_ns: int) -> list[Output]:
        """End the waiting: all that the caches have is here. Returns what was held for it."""
        self._waiting.recovery_ns = None
        return self._advance(now_ns)

    # What it is

    @property
    def parameters(self) -> optipmb.Parameters:
        """The profile."""
        return self._stepper.parameters

    @property
    def session(self) -> str:
        """The id of the present life of the density."""
        return self._history.head.session

    @property
    def density(self) -> optipmb.Density:
        """The density after the last frame."""
        return self._history.head.density

    @property
    def counters(self) -> Counters:
        """What happened to the messages so far."""
        return counters_of(self._deliveries, self._history.head.counts)

    @property
    def run(self) -> int:
        """How often the session was taken up again.

        A frame that was tracked before a crash, with others missing, may be tracked again after it with these there,
        and nobody knows any more under which revision it was published. What a later run publishes of a frame holds.
        """
        return self._run

    @property
    def quarantine(self) -> str:
        """The error for which frames are refused; empty while they are not."""
        return self._quarantine

    @property
    def cloud_wait_s(self) -> float:
        """The longest wait for a cloud."""
        return self._policy.cloud_wait_ns / SECOND

    @property
    def life(self) -> Life:
        """What a later session of the stream has to know."""
        head = self._history.head
        return Life(head.starts, head.density.next_id)

    def state(self, *, shed: int = 0, queue: int = 0, closed: bool = False) -> schemas.SessionState:
        """Return the state as the message that answers a query."""
        return state_of(
            self.stream,
            self.parameters.name,
            self._history.head,
            self.counters,
            condition=self._condition(closed=closed),
            shed=shed,
            queue=queue + len(self._waiting),
        )

    def _condition(self, *, closed: bool) -> Condition:
        if closed:
            return "closed"
        if self._quarantine:
            return "quarantined"
        if self.recovering:
            return "recovering"
        return "running" if self.counters.frames else "new"

    # The order of things

    def _advance(self, now_ns: int | None) -> list[Output]:
        """Process the frames that are ready, in order; None: all of them."""
        outputs: list[Output] = []
        while (ready := self._waiting.take(now_ns, self._complete, self._cloud)) is not None:
            outputs += self._process(ready)
        return outputs

    def _complete(self, mark: Mark) -> bool:
        return self._done.complete_until(mark, self._history.head.tracked)

    def _cloud(self, held: Held) -> schemas.Points | None:
        if held.message.has_points is False:
            return None
        return self._clouds.get(held.mark.epoch, held.mark.stamp_ns, self._arrived.knows)

    def _process(self, ready: Ready) -> list[Output]:
        """Put a frame in its place; when a step raises, the session is quarantined as it was before."""
        began_ns = self._clock()
        held, points = ready.held, ready.points
        mark = held.mark
        decision, done = self._done.judge(mark)
        if not decision.verdict.admitted:
            return self._refuse(mark, decision)
        weight = weigh(held.message, points)
        entry = Entry(mark, decision.place, held.message, points, ready.missed, 0, held.frame, held.ignored, weight)
        placed = [*self._history.entries, entry] if decision.last else self._history.inserted(entry, done.places())
        before = self.session
        try:
            outcomes = self._history.append(entry) if decision.last else self._history.redo(placed)
        except Exception as error:  # noqa: BLE001 - a fault in one session's step must not end the others
            return self._fail(error, placed, mark)
        self._settle(done)
        self._deliveries.inserted += not decision.last
        return self._report(outcomes, before, held.ticket, began_ns)

    def _amend(self, message: schemas.Points, ticket: Any) -> list[Output]:
        """Put a cloud that came after its frame into the window."""
        began_ns, before = self._clock(), self.session
        placed = self._history.amended(message, self._done.knows)
        if all(new is old for new, old in zip(placed, self._history.entries, strict=True)):
            return []
        try:
            outcomes = self._history.redo(placed)
        except Exception as error:  # noqa: BLE001 - as above
            return self._fail(error, placed, Mark(message.epoch, message.seq, message.stamp_ns))
        self._settle(self._done)
        self._deliveries.inserted += 1
        return self._report(outcomes, before, ticket, began_ns)

    def _report(self, outcomes: list[Outcome], before: str, ticket: Any, began_ns: int) -> list[Output]:
        """Return what is to be told of frames that were gone through."""
        outputs: list[Output] = []
        begins = next((one.begins for one in reversed(outcomes) if one.begins), None)
        if begins is not None and self.session != before:
            outputs.append(Begun(self.session, begins.reason, begins.jump_ns))
        step_ns = (self._clock() - began_ns) // max(1, len(outcomes))
        for one in outcomes:
            if one.entry.revision == 0:
                outputs += self._complain.unknown(one.entry.mark, one.unknown, self.parameters)
                if one.tracks is None:
                    outputs.append(self._complain.astray(one.entry, self._policy))
            if one.tracks is not None:
                self._deliveries.corrected += one.entry.revision > 0
                outputs.append(Tracked(one.tracks, ticket, step_ns, self._run))
        return outputs

    def _refuse(self, mark: Mark, decision: Decision) -> list[Output]:
        if decision.verdict is Verdict.DUPLICATE:
            self._deliveries.duplicates += 1
            return []
        if decision.verdict is Verdict.RETIRED:
            self._deliveries.refused += 1
            return [self._complain.retired(mark)]
        self._deliveries.late += 1
        return [self._complain.late(mark, decision.place.jump_ns)]

    def _fail(self, error: Exception, placed: list[Entry], mark: Mark) -> list[Output]:
        """Take no more frames; the one that failed and what is held go, unprocessed."""
        self._quarantine = f"{type(error).__name__}: {error}"[:MAX_ERROR]
        self._deliveries.refused += 1 + self._waiting.clear()
        self._done = self._arrived = self._done.note(mark)
        dump = dump_of(self._stepper, self._history.base, placed, self._policy, error)
        return [self._complain.failed(mark, self._quarantine), Quarantined(self._quarantine, dump)]

    def _settle(self, done: Timeline) -> None:
        """Take over the timeline with a frame, and let go what the window does not hold any more."""
        gone = self._history.trim(self._policy)
        base = self._history.base
        if gone:
            done = done.settle(base.course, base.last, gone)
            self._arrived = self._arrived.settle(base.course, base.last, gone)
            if base.last is not None:
                self._clouds.forget_before(base.last.stamp_ns, self._policy.gap_limit_ns)
        self._done = done
        if not self._waiting:
            self._arrived = done

    def _begin(self, moment: Moment) -> None:
        """Go on from a moment without a way back behind it."""
        self._history = History(moment, _weakly(self._step))
        self._done = self._done.settle(moment.course, moment.last, frozenset(self._done.marks))
        self._arrived = self._done

    def _resume(self, checkpoint: Checkpoint, now_ns: int) -> None:
        if checkpoint.cloud_wait_ns is not None:
            self._wait(checkpoint.cloud_wait_ns)
        self._quarantine = checkpoint.quarantine
        self._deliveries = replace(checkpoint.deliveries)
        self._clouds.newest_ns = checkpoint.newest_cloud_ns
        self._waiting.recovery_ns = now_ns + self._policy.recovery_wait_ns
        self._run = checkpoint.run + 1
        self._done, entries = window_of(checkpoint, self._policy.gap_limit_ns)
        self._arrived = self._done
        self._history = History(checkpoint.base, _weakly(self._step), entries, checkpoint.head)

    def _wait(self, cloud_wait_ns: int) -> None:
        self._cloud_wait_ns = cloud_wait_ns
        self._policy = replace(self._policy, cloud_wait_ns=cloud_wait_ns)

    def _step(self, before: Moment, entry: Entry) -> tuple[Moment, Outcome]:
        return self._stepper.step(before, entry, self._policy)


def _weakly(step: Step) -> Step:
    """Return a method without hold on its session: in a circle, a session that has ended would keep its clouds."""
    method = weakref.WeakMethod(step)

    def call(before: Moment, entry: Entry) -> tuple[Moment, Outcome]:
        bound = method()
        assert bound is not None  # noqa: S101 - whoever calls has the session: said for the type checker
        return bound(before, entry)

    return call
