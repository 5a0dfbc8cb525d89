"""One session: what decides about the messages of a stream, or of several sensors that feed one density.

No I/O, no threads, no clock of its own.

Conventions: `now_ns` is the local monotonic clock, handed in by the caller and used for nothing but waiting, for point
clouds and, after a restore, for frames that were missed; everything else follows from the messages. So the same
messages give the same tracks, byte for byte, and those of the window give the same state in whatever order they come.

The parts: `pending` holds the frames of a sensor until they are ready, `processed` has those that were gone through,
`reporting` says and counts what became of them. Here are commands, the state to be written down, and what is done when
a step fails.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import optipmb
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import Checkpoint
from optipmb_service.session.dump import dump_of
from optipmb_service.session.fused_timeline import FusedTimeline
from optipmb_service.session.pending import PendingFrames
from optipmb_service.session.processed import ProcessedFrames
from optipmb_service.session.reporting import SessionReporting
from optipmb_service.session.timeline import FrameId
from optipmb_service.session.transition import Transition
from optipmb_service.session.values import (
    MAX_CLOUD_WAIT_NS,
    MAX_ERROR,
    MAX_SENSORS,
    SECOND,
    Begun,
    Counters,
    Lineage,
    Output,
    Policy,
    Quarantined,
    RefusedError,
    total,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.session.pending import Ready
    from optipmb_service.session.reporting import Condition
    from optipmb_service.session.state import Entry, FilterState
    from optipmb_service.session.timeline import Timeline
    from optipmb_service.session.values import Steps


class Session:
    """The state of one stream, or of several that share a density.

    Args:
        stream: `site/node/sensor`; that of the tracks, where several sensors feed the session.
        parameters: the profile to track with.
        policy: waiting, restarting, going back.
        fused: whether frames are those of several sensors, by the streams of the messages.
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
        fused: bool = False,
        instance: str = "session",
        life: Lineage | None = None,
        tracker: Callable[[optipmb.Parameters], Steps] = optipmb.Tracker,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self.stream = stream
        self._fused = fused
        self._policy = _of_several(policy or Policy()) if fused else policy or Policy()
        self._cloud_wait_ns: int | None = None
        self._reporting = SessionReporting(stream, instance, self._policy)
        self._clock = clock
        self._make = tracker
        self._processed = ProcessedFrames(self._transition(parameters), self._policy, life or Lineage(), fused=fused)
        self._pending: dict[str, PendingFrames] = {}
        self._recovery_ns: int | None = None
        self._began: tuple[int, int] | None = None
        self._backlog = False
        self._young_ns: int | None = None
        self._now_ns = 0
        self._quarantine: dict[str, str] = {}
        self._run = life.run if life else 0
        self._restored = False
        if not fused:
            self._sensor("")

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
        frame_id = self._frame_id(message)
        outputs: list[Output] = []
        pending = self._sensor(frame_id.sensor)
        if pending is None:
            self._reporting.deliveries.refused += 1
            return [self._reporting.complain.too_many(frame_id)]
        if error := self._quarantine.get(frame_id.sensor):
            if self._processed.timeline.knows(frame_id):
                self._reporting.deliveries.refused += 1
                return [self._reporting.complain.quarantined(frame_id, error)]
            outputs += self._released(frame_id.sensor)
        if (
            self._fused
            and not (self._restored or self.counters.frames or self._began)
            and self._policy.recovery_wait_ns
        ):
            self._began = frame_id.stamp_ns, now_ns if arrived_ns is None else arrived_ns
            self._recover_until(now_ns + self._policy.recovery_wait_ns)
        judged_by = pending.timeline
        decision, arrived = judged_by.judge(frame_id)
        if not decision.verdict.admitted:
            self._remember(pending, judged_by, arrived)
            return [*outputs, *self._reporting.refused(frame_id, decision)]
        try:
            frame, ignored = convert.frame_of(self.parameters, message)
        except optipmb.FrameError as invalid:
            self._reporting.deliveries.refused += 1
            self._processed.note(frame_id)
            pending.timeline = judged_by.note(frame_id)
            self._follow()
            return [*outputs, self._reporting.complain.invalid(frame_id, invalid)]
        pending.timeline = arrived
        since_ns = now_ns if arrived_ns is None else arrived_ns
        judged = judged_by, decision, arrived
        pending.add(message, frame_id, frame, ignored, since_ns, ticket, judged)
        return [*outputs, *self._advance(now_ns)]

    def on_points(self, message: schemas.Points, now_ns: int, *, ticket: Any = None) -> list[Output]:
        """Take a cloud; returns what waited for it and, by setting, what it corrects.

        Args:
            message: the cloud.
            now_ns: monotonic time.
            ticket: comes back with the tracks that the cloud corrects.
        """
        frame_id = self._frame_id(message)
        try:
            convert.cloud_of(message)
        except optipmb.FrameError as error:
            return [self._reporting.complain.invalid(frame_id, error)]
        pending = self._sensor(frame_id.sensor)
        if pending is None:
            return [self._reporting.complain.too_many(frame_id)]
        pending.clouds.add(message)
        amends = self._policy.late_clouds and frame_id.sensor not in self._quarantine
        outputs = self._amend(message, frame_id, ticket) if amends else []
        return [*outputs, *self._advance(now_ns)]

    def on_tick(self, now_ns: int) -> list[Output]:
        """Return what need not wait any longer."""
        return self._advance(now_ns)

    @property
    def deadline_ns(self) -> int | None:
        """When `on_tick` is due (monotonic, ns); None while nothing is held."""
        due = [one.deadline_ns(self._complete_until) for one in self._pending.values()]
        return min((one for one in due if one is not None), default=None)

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
        self._quarantine.clear()
        head, starts = self._processed.head, self._processed.head.starts + 1
        density = optipmb.Density.empty(self._processed.transition.parameters.labels, head.density.next_id)
        self._begin(head.begun_anew(density, self._processed.transition.name(head.last, starts), starts))
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
            fused=self._fused,
            cloud_wait_ns=self._cloud_wait_ns,
            quarantine=dict(self._quarantine),
            seen=self._processed.timeline.seen,
            base=base,
            window=window,
            head=self._processed.head,
            deliveries=replace(self._reporting.deliveries),
            newest_cloud_ns={
                name: one.clouds.newest_ns for name, one in self._pending.items() if one.clouds.newest_ns is not None
            },
            run=self._run,
        )

    @classmethod
    def restore(
        cls,
        checkpoint: Checkpoint,
        now_ns: int,
        policy: Policy | None = None,
        *,
        fence: int = 1,
        instance: str = "session",
        tracker: Callable[[optipmb.Parameters], Steps] = optipmb.Tracker,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> Self:
        """Return the session that a checkpoint was taken of. It is `recovering` for a while.

        Its tracks belong to another `run`, whose number is that of the checkpoint and the fence together: of two
        sessions that go on from one checkpoint the later one has the higher fence, whatever the other has written down.

        Args:
            checkpoint: its state; its profile goes on too.
            now_ns: monotonic time; the waiting for missed frames begins now.
            policy: waiting, restarting, going back.
            fence: of the lease under which it goes on, 1 or higher.
            instance: name of the service, for problems.
            tracker: makes the tracker.
            clock: measures how long a step takes, ns.

        Raises:
            CheckpointError: its frames do not fit together.
        """
        session = cls(
            checkpoint.stream,
            checkpoint.parameters,
            policy,
            fused=checkpoint.fused,
            instance=instance,
            tracker=tracker,
            clock=clock,
        )
        session._resume(checkpoint, now_ns)
        session._run = total(checkpoint.run, fence)
        return session

    @property
    def recovering(self) -> bool:
        """Whether frames behind a gap are held, because those missing may still come from the publisher's cache."""
        return self._recovery_ns is not None and not self._began

    @property
    def awaits_caches(self) -> bool:
        """Whether frames are held because others before them, or of other sensors, may still come from caches."""
        return self._recovery_ns is not None

    @property
    def young_since_ns(self) -> int | None:
        """Since when, monotonic, it `awaits_caches`, if it began so lately that it may not know all its sensors."""
        if self._recovery_ns is None or (self._began is None and self._young_ns is None):
            return None
        return self._recovery_ns - self._policy.recovery_wait_ns

    @property
    def sensors(self) -> set[str]:
        """The sensors that it knows of, by stream; of one stream an empty name."""
        return set(self._pending)

    def recovered(self, now_ns: int) -> list[Output]:
        """End the waiting: all that the caches had is here. Returns what was held for it."""
        self._recover_until(None)
        return self._advance(now_ns)

    def unprocessed(self) -> list[tuple[schemas.Detections | schemas.Points, Any]]:
        """Return what came and is in no snapshot: clouds without their frame, and frames held, each with its ticket."""
        used = frozenset(id(entry.points) for entry in self._processed.entries)
        return [one for pending in self._pending.values() for one in pending.unprocessed(used)]

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
        """Number that grows whenever a session of the stream begins or is taken up again, by whichever process.

        A frame that was tracked before a crash, with others missing, may be tracked again after it with these there,
        and nobody knows any more under which revision it was published. What a later run publishes of a frame holds.
        """
        return self._run

    @property
    def held(self) -> int:
        """Frames that wait."""
        return sum(map(len, self._pending.values()))

    @property
    def held_bytes(self) -> int:
        """Bytes of the messages that are kept: frames that wait, clouds, and the window; nearly, for any thread."""
        window = sum(entry.weight for entry in self._processed.entries)
        return window + sum(one.held_bytes + one.clouds.bytes for one in tuple(self._pending.values()))

    @property
    def quarantine(self) -> str:
        """The error for which frames are refused, of any sensor; empty while none are."""
        return next(iter(self._quarantine.values()), "")

    @property
    def cloud_wait_s(self) -> float:
        """The longest wait for a cloud."""
        return self._policy.cloud_wait_ns / SECOND

    @property
    def life(self) -> Lineage:
        """What a later session of the stream has to know."""
        head = self._processed.head
        return Lineage(head.starts, head.density.next_id, self._run)

    def state(self, *, shed: int = 0, queue: int = 0, closed: bool = False) -> schemas.SessionState:
        """Return the state as the message that answers a query."""
        return self._reporting.state(
            self.parameters.name,
            self._processed.head,
            condition="closed" if closed else self._condition,
            shed=shed,
            queue=queue + self.held,
        )

    @property
    def _condition(self) -> Condition:
        if self._quarantine and self._quarantine.keys() >= self._pending.keys():
            return "quarantined"
        if self.recovering:
            return "recovering"
        return "running" if self.counters.frames else "new"

    # The order of things

    def _advance(self, now_ns: int | None) -> list[Output]:
        """Process the frames that are ready, in order; None: all of them."""
        self._now_ns = self._now_ns if now_ns is None else now_ns
        if now_ns is not None and self._recovery_ns is not None and now_ns >= self._recovery_ns:
            self._recover_until(None)
        outputs: list[Output] = []
        while ready := self._ready(now_ns):
            outputs += self._process(ready)
        return outputs

    def _ready(self, now_ns: int | None) -> Ready | None:
        """Take the earliest of the frames that are ready; no sensor waits for another."""
        waiting = [one for one in self._pending.values() if len(one)]
        for one in waiting if len(waiting) < 2 else sorted(waiting, key=_earliest):  # noqa: PLR2004 - one is in order
            if ready := one.take(now_ns, self._complete_until):
                return ready
        return None

    def _complete_until(self, frame_id: FrameId) -> bool:
        """Whether no frame is missing before one: of its sensor, and after a restore of those that were live.

        When a session of several sensors begins, their caches come one after the other, too: until it is known which
        sensors there are, none goes ahead of the time that has passed by more than half of the time for which late
        frames are taken; the other half is for sensors that began a little earlier and are heard of a little later.
        """
        timeline, margin_ns = self._processed.timeline, self._policy.rewind_ns // 2
        if self._began:
            stamp_ns, began_ns = self._began
            ahead_ns = frame_id.stamp_ns - stamp_ns - margin_ns
            # Stamps that pass faster than time come from a cache, and the other caches begin as early.
            self._backlog |= ahead_ns > self._now_ns - began_ns
            return ahead_ns <= (0 if self._backlog else self._now_ns - began_ns)
        if isinstance(timeline, FusedTimeline) and self.recovering:
            if self._young_ns is not None and frame_id.stamp_ns - self._young_ns > margin_ns:
                return False
            for name, newest_ns in timeline.live().items():
                held = self._pending[name].first if name in self._pending else None
                reached_ns = newest_ns if held is None else held.stamp_ns
                if name != frame_id.sensor and reached_ns < frame_id.stamp_ns:
                    return False
        return self._processed.complete_until(frame_id)

    def _process(self, ready: Ready) -> list[Output]:
        """Put a frame in its place."""
        began_ns, frame_id = self._clock(), ready.held.frame_id
        judged_by, decision, timeline = ready.held.judged
        if judged_by is not self._processed.timeline:  # others were held when it came
            decision, timeline = self._processed.timeline.judge(frame_id)
        if not decision.verdict.admitted:
            self._processed.timeline = timeline
            return self._reporting.refused(frame_id, decision)
        placed = self._processed.placed(ready, decision, timeline)
        return self._go(placed, timeline, frame_id, ready.held.ticket, began_ns, behind=decision.last)

    def _amend(self, message: schemas.Points, frame_id: FrameId, ticket: Any) -> list[Output]:
        """Put a cloud that came after its frame into the window."""
        began_ns, placed = self._clock(), self._processed.amended(message, frame_id)
        return (
            []
            if placed is None
            else self._go(placed, self._processed.timeline, frame_id, ticket, began_ns, behind=False)
        )

    def _go(
        self,
        placed: list[Entry],
        timeline: Timeline | FusedTimeline,
        frame_id: FrameId,
        ticket: Any,
        began_ns: int,
        *,
        behind: bool,
    ) -> list[Output]:
        """Go through frames with what is new among them; when a step raises, the session is quarantined as it was."""
        before = self.session
        try:
            outcomes = self._processed.go(placed, behind=behind)
        except Exception as error:  # noqa: BLE001 - a fault in one session's step must not end the others
            return self._fail(error, placed, frame_id)
        gone = self._processed.settle(timeline)
        self._follow(gone)
        self._reporting.deliveries.inserted += not behind
        begun = self._reporting.begun(outcomes, before, self.session)
        took_ns = self._clock() - began_ns
        return [*begun, *self._reporting.tracked(outcomes, self.parameters, ticket, took_ns, self._run)]

    def _fail(self, error: Exception, placed: list[Entry], frame_id: FrameId) -> list[Output]:
        """Take no more frames of the sensor; the one that failed and what is held go, unprocessed."""
        reason = self._quarantine[frame_id.sensor] = f"{type(error).__name__}: {error}"[:MAX_ERROR]
        self._reporting.deliveries.refused += 1 + self._pending[frame_id.sensor].clear()
        self._processed.note(frame_id)
        self._follow()
        dump = dump_of(self._processed.transition, self._processed.base, placed, error)
        return [self._reporting.complain.failed(frame_id, reason), Quarantined(reason, dump)]

    def _released(self, sensor: str) -> list[Output]:
        """End the quarantine of a sensor whose publisher was started anew; the density of others goes on."""
        if not self._fused:
            return self.reset("quarantine")
        del self._quarantine[sensor]
        return []

    def _begin(self, state: FilterState, transition: Transition | None = None) -> None:
        """Go on from a moment without a way back behind it."""
        self._processed.begin(state, transition)
        for one in self._pending.values():
            one.timeline = self._processed.timeline

    def _resume(self, checkpoint: Checkpoint, now_ns: int) -> None:
        if checkpoint.cloud_wait_ns is not None:
            self._wait(checkpoint.cloud_wait_ns)
        self._quarantine = dict(checkpoint.quarantine)
        self._reporting.deliveries = replace(checkpoint.deliveries)
        self._recovery_ns = now_ns + self._policy.recovery_wait_ns
        if self._fused and checkpoint.base.last is None:
            # Of the beginning of a session: other sensors may have been there that it does not know yet.
            self._young_ns = min((one.message.stamp_ns for one in checkpoint.window), default=None)
        self._restored = True
        self._processed.resume(checkpoint)
        self._pending.clear()
        for name in ("",) if not self._fused else checkpoint.head.sensors:
            if (pending := self._sensor(name)) is not None:
                pending.clouds.newest_ns = checkpoint.newest_cloud_ns.get(name)

    def _wait(self, cloud_wait_ns: int) -> None:
        self._cloud_wait_ns = cloud_wait_ns
        policy = replace(self._policy, cloud_wait_ns=cloud_wait_ns)
        self._policy = _of_several(policy) if self._fused else policy
        for one in self._pending.values():
            one.policy = self._policy

    def _frame_id(self, message: schemas.Detections | schemas.Points) -> FrameId:
        return FrameId(message.epoch, message.seq, message.stamp_ns, message.stream if self._fused else "")

    def _sensor(self, name: str) -> PendingFrames | None:
        """Return what is held of a sensor, nothing for a new one; None when there are too many."""
        pending = self._pending.get(name)
        if pending is None and len(self._pending) >= MAX_SENSORS:
            self._forget_one()
        if pending is None and len(self._pending) < MAX_SENSORS:
            pending = self._pending[name] = PendingFrames(self._policy, self._processed.timeline)
            pending.recovery_ns = self._recovery_ns
        return pending

    def _forget_one(self) -> None:
        """Make room for a sensor: the one that fed the session longest ago goes, if that is not lately."""
        timeline = self._processed.timeline
        if isinstance(timeline, FusedTimeline):
            live, newest_ns = timeline.live(), timeline.clock
            silent = [name for name, one in self._pending.items() if not len(one) and name not in live]
            if silent:
                name = min(silent, key=lambda one: (newest_ns.get(one, -1), one))
                del self._pending[name]
                self._quarantine.pop(name, None)

    def _remember(
        self, pending: PendingFrames, judged_by: Timeline | FusedTimeline, arrived: Timeline | FusedTimeline
    ) -> None:
        """Keep what a timeline remembers of a frame that it refused."""
        pending.timeline = arrived
        if self._processed.timeline is judged_by is not arrived:
            self._processed.timeline = arrived
            self._follow()

    def _recover_until(self, recovery_ns: int | None) -> None:
        self._recovery_ns = recovery_ns
        if not recovery_ns:
            self._began, self._backlog, self._young_ns = None, False, None
        for one in self._pending.values():
            one.recovery_ns = recovery_ns

    def _follow(self, gone: frozenset[FrameId] = frozenset()) -> None:
        for one in self._pending.values():
            one.follow(self._processed.timeline, self._processed.base, gone)

    def _transition(self, parameters: optipmb.Parameters) -> Transition:
        return Transition(self.stream, parameters, self._make(parameters), self._policy)


def _of_several(policy: Policy) -> Policy:
    """Return the policy of several sensors: a frame that waited for its cloud must still find its place."""
    return replace(policy, cloud_wait_ns=min(policy.cloud_wait_ns, policy.rewind_ns // 2))


def _earliest(one: PendingFrames) -> tuple[int, str]:
    first = one.first
    return (first.stamp_ns, first.sensor) if first else (0, "")
