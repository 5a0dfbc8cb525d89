"""Session: the tracking of one stream, or of several sensors that feed one density.

No I/O and no threads. Of the clock it reads only how long steps and flushes take.

Conventions: `now_ns` is the local monotonic clock, given by the caller and used only for waiting, for point clouds and,
during recovery, for frames that were missed; everything else follows from the messages. So the same messages give the
same tracks, byte for byte, and frames of the window give the same state in any order.

A frame that arrives is judged by the timeline (`on_detections`) and waits in the queue of its sensor (`pending`) until
it is ready (`_advance`). Then it goes into the window (`window`), which takes it, and the frames behind it, through the
tracker (`transition`). When a step raises, nothing has changed but that the sensor of the frame is quarantined: the
frame and the pending frames of the sensor go, unprocessed, and its frames are refused until a reset or a restart of its
publisher.
"""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, Final, Literal, Self

import optipmb_schemas as schemas

import optipmb
from optipmb.learning.self_calibration import learned_noise
from optipmb.world.zones import ZoneState
from optipmb_service.session import convert
from optipmb_service.session.arrivals import Arrivals
from optipmb_service.session.checkpoint import MAX_ERROR, Checkpoint
from optipmb_service.session.checks import ScoreChecks
from optipmb_service.session.counts import Counters, Deliveries, present, total
from optipmb_service.session.frame_problems import FrameProblems
from optipmb_service.session.identity import Incarnation
from optipmb_service.session.outputs import Begun, CommandRefusedError, Output, Quarantined, events_of
from optipmb_service.session.pending import PendingFrame, SensorQueues
from optipmb_service.session.policy import MAX_CLOUD_WAIT_NS, Policy
from optipmb_service.session.state import FilterState, ProcessedFrame
from optipmb_service.session.timeline import FrameId, FusedTimeline, StreamTimeline, Verdict
from optipmb_service.session.transition import Transition
from optipmb_service.session.window import ReorderWindow
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb_service.session.identity import Reached
    from optipmb_service.session.outputs import Reason, TrackedFrame
    from optipmb_service.session.pending import Judged, SensorQueue
    from optipmb_service.session.state import Inputs
    from optipmb_service.session.timeline import Decision, Timeline
    from optipmb_service.session.transition import Outcome

    Condition = Literal["new", "running", "recovering", "quarantined", "closed"]

FLUSH_NS: Final = SECOND
"""Longest time for all pending frames at a reset, a change of parameters or the end: others wait for them."""


class Session:
    """The state of one stream, or of several that share a density.

    Args:
        stream: `site/node/sensor`, or the name of a fused session.
        parameters: the profile to track with.
        policy: waiting, restarting, going back.
        fused: whether several sensors feed it, told apart by the streams of the messages.
        instance: name of the service, for problems.
        incarnation: ids that an earlier session of the stream used.
        tracker: makes the tracker; tests put their own here.
    """

    def __init__(
        self,
        stream: str,
        parameters: optipmb.Parameters,
        policy: Policy | None = None,
        *,
        fused: bool = False,
        instance: str = "session",
        incarnation: Incarnation | None = None,
        tracker: Callable[..., optipmb.Tracker] = optipmb.Tracker,
    ) -> None:
        incarnation = incarnation or Incarnation()
        self.stream = stream
        self.run = incarnation.run
        """Number that grows whenever a session of the stream begins or is restored, by whichever process.

        A frame that was tracked before a crash may be tracked again after it, with others that were missing then. Its
        last revision is not known any more, so the tracks of a later run replace earlier ones.
        """
        self._fused = fused
        self._make = tracker
        self._estimated = ""
        """Incarnation in which the motion of a sensor was reported as estimated."""
        self._deliveries = Deliveries()
        self._has_ready = False
        self._cloud_wait_ns: int | None = None
        self._policy = policy or Policy()
        self._queues = SensorQueues(self._policy)
        self._problems = FrameProblems(stream, instance, self._policy)
        self._limit_wait(self._policy.cloud_wait_ns)
        limits, transition = self._policy.jump_limits, self._transition(parameters)
        self._timeline: Timeline = FusedTimeline(limits) if fused else StreamTimeline(limits, {"": ()})
        name = transition.name(None, incarnation.starts)
        zones = ZoneState(numbers=incarnation.events) if incarnation.events else None
        start = FilterState(transition.no_objects(incarnation.next_id), name, incarnation.starts, zones=zones)
        self._window = ReorderWindow(start, transition)
        self.arrivals = Arrivals(self._policy, self._queues)
        self._now_ns = 0
        """When frames became ready last (monotonic)."""
        if not fused:
            self._queues.open("", self._timeline)

    # Messages

    def on_detections(
        self, message: schemas.Detections, now_ns: int, *, arrived_ns: int | None = None, ticket: Any = None
    ) -> list[Output]:
        """Take a frame; return the outputs of all frames that it made ready, itself or pending ones.

        Args:
            message: the frame.
            now_ns: monotonic time.
            arrived_ns: when the frame arrived, if before now: its wait for a cloud began then.
            ticket: comes back with the tracks of the frame and the tracks that it corrects.
        """
        frame_id = self._frame_id(message)
        since_ns = now_ns if arrived_ns is None else arrived_ns
        queue = self._queues.open(frame_id.sensor, self._timeline)
        if queue is None:
            self.refuse()
            return [self._problems.too_many_sensors(frame_id)]
        outputs: list[Output] = []
        if queue.quarantine:
            if self._timeline.knows(frame_id):
                expected = "a reset or a restarted publisher: the session is quarantined"
                return self._refuse(self._problems.of("quarantined", frame_id, "", expected, queue.quarantine))
            queue.quarantine = ""  # the density of other sensors goes on
            outputs += [] if self._fused else self.reset("quarantine")
        if self._fused and not self._window.head.counts.frames:
            self.arrivals.begin(frame_id.stamp_ns, since_ns, now_ns)
        judged = queue.judge(frame_id)
        if queue.is_alive(frame_id, judged[1]):
            outputs += self._reinstate(frame_id)
            judged = queue.judge(frame_id)
        if judged[1].verdict.admitted:
            return [*outputs, *self._admit(queue, frame_id, judged, message, now_ns, since_ns, ticket)]
        return [*outputs, *self._not_admitted(queue, frame_id, judged, message)]

    def on_points(self, message: schemas.Points, now_ns: int, *, ticket: Any = None) -> list[Output]:
        """Take a cloud; return the outputs of frames that waited for it and, by setting, corrected ones.

        Args:
            message: the cloud.
            now_ns: monotonic time.
            ticket: comes back with the tracks that the cloud corrects.
        """
        frame_id = self._frame_id(message)
        try:
            convert.cloud_of(message)
        except optipmb.FrameError as error:
            return [self._problems.invalid(frame_id, error)]
        queue = self._queues.open(frame_id.sensor, self._timeline)
        if queue is None:
            return [self._problems.too_many_sensors(frame_id)]
        queue.clouds.add(message)
        amends = self._policy.late_clouds and not queue.quarantine
        outputs = self._amend(message, frame_id, ticket) if amends else []
        return [*outputs, *self._advance(now_ns)]

    def on_tick(self, now_ns: int) -> list[Output]:
        """Return the outputs of frames that need not wait any longer."""
        return self._advance(now_ns)

    @property
    def deadline_ns(self) -> int | None:
        """When `on_tick` is due (monotonic, ns), 0: at once; None while no frame waits."""
        if self._has_ready:
            return 0
        due = [self._due_ns(one.held[0]) for one in self._queues.values() if one.held]
        return min((one for one in due if one is not None), default=None)

    def refuse(self) -> None:
        """Count a message of the stream that was not valid."""
        self._deliveries.refused += 1

    # Commands

    def flush(self) -> list[Output]:
        """Process the pending frames, without waiting any longer."""
        return self._advance(None)

    def reset(self, reason: Reason = "reset") -> list[Output]:
        """Discard the density; frames seen before stay seen, track ids go on, a quarantine ends."""
        outputs = self.flush()
        for queue in self._queues.values():
            queue.quarantine = ""
        head, transition = self._window.head, self._window.transition
        session = transition.name(head.last, head.starts + 1)
        self._begin(head.begun_anew(transition.no_objects(head.density.next_id), session))
        return [*outputs, Begun(self.session, reason)]

    def configure(
        self,
        parameters: optipmb.Parameters | None,
        cloud_wait_s: float | None,
        horizons: Sequence[float] | None = None,
        *,
        restart: bool,
    ) -> list[Output]:
        """Change the settings of the session; another profile only before the first frame or with `restart`.

        Args:
            parameters: the profile; None: as before.
            cloud_wait_s: the longest wait for a cloud; None: as before.
            horizons: valid horizons of predicted paths; None: from the profile that is set, else as before.
            restart: whether the density may be discarded.

        Raises:
            CommandRefusedError: another profile after frames were processed, without a restart; or too long a wait.
        """
        if cloud_wait_s is not None and cloud_wait_s * SECOND > MAX_CLOUD_WAIT_NS:
            longest = f"at most {MAX_CLOUD_WAIT_NS / SECOND:g} seconds"
            raise CommandRefusedError("cloud_wait_s", longest, f"{cloud_wait_s:g}")
        before, frames = self.parameters, self.counters.frames
        wanted = parameters or before
        if horizons is not None:
            wanted = wanted.model_copy(update={"horizons": tuple(horizons)})
        changes = wanted.model_copy(update={"horizons": before.horizons}) != before
        if changes and not restart and frames:
            expected = f"{before.name!r}, or restart = true: {frames} frames have been tracked with it"
            raise CommandRefusedError("profile", expected, repr(wanted.name))
        outputs = self.flush() if changes else []
        if cloud_wait_s is not None:
            self._cloud_wait_ns = round(cloud_wait_s * SECOND)
            self._limit_wait(self._cloud_wait_ns)
        if changes:
            # Frames are given to the tracker by the classes of the old profile: they cannot be processed again.
            self._begin(self._window.head, self._transition(wanted))
        elif wanted != before:
            self._window.transition = self._transition(wanted)
        if restart:
            return [*outputs, *self.reset("parameters")]
        if changes:
            head, transition = self._window.head, self._window.transition
            density = transition.no_objects(head.density.next_id)
            self._begin(replace(head, session=transition.name(None, head.starts), density=density))
        return outputs

    # Checkpoints and recovery

    def snapshot(self) -> Checkpoint:
        """Return the state between two frames, without pending ones, which come again from the publisher's cache.

        It refers to values that never change: cheap, to be encoded later.
        """
        base, window = self._window.portable(self._policy.checkpoint_bytes)
        newest = {name: one.clouds.newest_ns for name, one in self._queues.items()}
        return Checkpoint(
            stream=self.stream,
            parameters=self.parameters,
            fused=self._fused,
            cloud_wait_ns=self._cloud_wait_ns,
            quarantine={name: one.quarantine for name, one in self._queues.items() if one.quarantine},
            seen=self._timeline.seen,
            base=base,
            window=window,
            head=self._window.head,
            deliveries=replace(self._deliveries),
            newest_cloud_ns={name: newest_ns for name, newest_ns in newest.items() if newest_ns is not None},
            run=self.run,
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
        tracker: Callable[..., optipmb.Tracker] = optipmb.Tracker,
    ) -> Self:
        """Return the session that a checkpoint was taken of. It is `recovering` for a while.

        Its tracks belong to another `run`, whose number is the sum of the checkpoint's and the fence: of two
        sessions that go on from one checkpoint the later one has the higher fence, whichever wrote last.

        Args:
            checkpoint: its state; its profile goes on too.
            now_ns: monotonic time; the waiting for missed frames begins now.
            policy: waiting, restarting, going back.
            fence: of the lease under which it goes on, 1 or higher.
            instance: name of the service, for problems.
            tracker: makes the tracker.
        """
        one = cls(
            checkpoint.stream,
            checkpoint.parameters,
            policy,
            fused=checkpoint.fused,
            instance=instance,
            tracker=tracker,
        )
        one._cloud_wait_ns = checkpoint.cloud_wait_ns
        if one._cloud_wait_ns is not None:
            one._limit_wait(one._cloud_wait_ns)
        one.run = total(checkpoint.run, fence)
        one._deliveries = replace(checkpoint.deliveries)
        one._timeline = type(one._timeline).resume(one._policy.jump_limits, checkpoint)
        one._window = ReorderWindow.resume(checkpoint, one._window.transition, one._timeline.places())
        one._queues.resume(checkpoint, one._timeline)
        one.arrivals.resume(now_ns, checkpoint.young_ns)
        return one

    @property
    def sensors(self) -> set[str]:
        """The sensors that it knows of, by stream; of one stream an empty name."""
        return set(self._queues)

    def recovered(self, now_ns: int) -> list[Output]:
        """End the recovery: all that the caches had is here. Return the outputs of frames that waited for it."""
        self.arrivals.end()
        return self._advance(now_ns)

    def again(self) -> list[TrackedFrame]:
        """Return the tracks of the window once more, as of this run."""
        tracked = [one.tracks for one in self._window.again() if one.tracks is not None]
        for one in tracked:
            one.run, one.final = self.run, self._window.base.reached
        return tracked

    def unprocessed(self) -> list[tuple[schemas.Detections | schemas.Points, Any]]:
        """Return the messages that are in no snapshot: clouds without their frame, pending frames with their ticket."""
        used = frozenset(id(frame.points) for frame in self._window.frames)
        return [one for queue in self._queues.values() for one in queue.unprocessed(used)]

    # State

    @property
    def parameters(self) -> optipmb.Parameters:
        return self._window.transition.parameters

    @property
    def session(self) -> str:
        """Id of the present incarnation of the density."""
        return self._window.head.session

    @property
    def final(self) -> Reached:
        """Up to where no frame can be inserted any more."""
        return self._window.base.reached

    def zone_counts(self) -> schemas.Events | None:
        """Return the counts of all zones after the newest frame; None: there is none, or no zone."""
        head = self._window.head
        if (last := head.last) is None or head.zones is None or not self._policy.zones:
            return None
        header: dict[str, Any] = {"stream": self.stream, "session": head.session, "labels": self.parameters.labels}
        header |= {"epoch": last.epoch, "seq": last.seq, "stamp_ns": last.stamp_ns, "sensor": last.sensor or None}
        header["revision"] = next((one.revision for one in self._window.frames if one.frame_id == last), 0)
        return events_of(header, (), {one.name: head.zones.counts.get(one.name, {}) for one in self._policy.zones})

    @property
    def density(self) -> optipmb.Density:
        """The density after the last frame."""
        return self._window.head.density

    @property
    def counters(self) -> Counters:
        """Counts of the messages so far."""
        return Counters.of(self._window.head.counts, self._deliveries)

    @property
    def held(self) -> int:
        """Number of pending frames; may be called by any thread."""
        return self._queues.held

    @property
    def held_bytes(self) -> int:
        """Bytes of the messages that are kept: pending frames, clouds, and the window; nearly, for any thread.

        A cloud of the window is found by its stamp as well until its frame leaves the window: it counts once.
        """
        frames = self._window.frames
        used = frozenset(id(frame.points) for frame in frames)
        return sum(frame.weight for frame in frames) + self._queues.bytes_beside(used)

    @property
    def quarantine(self) -> str:
        """The error for which frames are refused, of any sensor; empty while none are."""
        return next((one.quarantine for one in self._queues.values() if one.quarantine), "")

    @property
    def cloud_wait_s(self) -> float:
        return self._policy.cloud_wait_ns / SECOND

    @property
    def incarnation(self) -> Incarnation:
        """The ids that it used, for a later session of the stream."""
        return self._window.head.incarnation(self.run)

    def state(self, *, shed: int = 0, queue: int = 0, closed: bool = False) -> schemas.SessionState:
        """Return the state as the message that answers a query.

        Args:
            shed: frames dropped before they came to the session.
            queue: frames that wait for the session.
            closed: whether it was closed.
        """
        head, counters = self._window.head, self.counters
        density, last = head.density, head.last
        condition: Condition = "running" if counters.frames else "new"
        if closed:
            condition = "closed"
        elif self._queues and all(one.quarantine for one in self._queues.values()):
            condition = "quarantined"
        elif self.arrivals.recovering:
            condition = "recovering"
        return schemas.SessionState(
            stream=self.stream,
            session=head.session,
            state=condition,
            profile=self.parameters.name,
            epoch=last.epoch if last else None,
            seq=last.seq if last else None,
            stamp_ns=last.stamp_ns if last else None,
            shed=shed,
            **{n: count for n, count in present(asdict(counters)).items() if n in schemas.SessionState.names},
            lost_objects=None if density.rejoining is None else len(density.rejoining.lost),
            tracks=head.tracks,
            bernoullis=len(density.bernoulli),
            poissons=len(density.poisson),
            next_id=density.next_id,
            queue=queue + self.held,
        )

    @property
    def learned(self) -> tuple[str, ...]:
        """Noise of the detections of each class, as far as it is learned; for any thread."""
        return learned_noise(self._window.head.density)

    # Settings

    def _transition(self, parameters: optipmb.Parameters) -> Transition:
        self._scores = ScoreChecks(parameters)
        return Transition(self.stream, parameters, self._make, self._policy)

    def _limit_wait(self, cloud_wait_ns: int) -> None:
        if self._fused:  # a frame that waited for its cloud must still find its place
            cloud_wait_ns = min(cloud_wait_ns, self._policy.rewind_ns // 2)
        self._policy = replace(self._policy, cloud_wait_ns=cloud_wait_ns)
        self._queues.set_policy(self._policy)

    def _frame_id(self, message: schemas.Detections | schemas.Points) -> FrameId:
        return FrameId(message.epoch, message.seq, message.stamp_ns, message.stream if self._fused else "")

    def _follow(self, timeline: Timeline, gone: Sequence[FrameId] = ()) -> None:
        """Go on with another timeline, and give it to the queues; `gone` are the frames that have left the window."""
        self._timeline = timeline
        for one in self._queues.values():
            one.follow(self._timeline, self._window.base, gone)

    def _until_ns(self, pending: PendingFrame) -> int | None:
        """Return until when (monotonic) a pending frame waits for others; None: it does not."""
        last = self._window.head.sensor(pending.frame_id.sensor).tracked
        return self.arrivals.until_ns(pending, self._now_ns, self._timeline, last)

    def _due_ns(self, pending: PendingFrame) -> int | None:
        """Return when a pending frame need not wait any longer (monotonic)."""
        until_ns = self._until_ns(pending)
        return pending.deadline_ns if until_ns is None else until_ns

    # Processing

    def _admit(
        self,
        queue: SensorQueue,
        frame_id: FrameId,
        judged: Judged,
        message: schemas.Detections,
        now_ns: int,
        since_ns: int,
        ticket: Any,
    ) -> list[Output]:
        """Process a frame that has a place, or hold it; return the outputs of all frames that it made ready."""
        parameters = self._window.transition.parameters_of(frame_id.sensor)
        detections = schemas.encoded(message)
        queue.remember(frame_id, detections)
        try:
            frame, ignored = convert.frame_of(parameters, message)
        except optipmb.FrameError as error:
            queue.timeline = judged[0].note(frame_id)
            self._follow(self._timeline.note(frame_id))
            return self._refuse(self._problems.invalid(frame_id, error))
        estimated = self.density.sensor_motion is not None
        findings = queue.checks.add(message, frame, since_ns, self._policy, estimated=estimated)
        findings += self._scores.add(frame_id, frame, parameters)
        outputs: list[Output] = [self._problems.of(one.code, frame_id, *one[1:]) for one in findings]
        deadline_ns, inputs = queue.cloud_deadline_ns(message, since_ns), (message, frame, ignored)
        pending = PendingFrame(frame_id, detections, inputs, deadline_ns, ticket, judged, since_ns)
        waits = queue.held or deadline_ns is not None or queue.clouds.newest_ns is not None
        if len(self._queues) == 1 and not waits and not self.arrivals.waiting:  # mostly
            self._now_ns, self._has_ready = now_ns, False
            return [*outputs, *self._process(pending)]
        queue.add(pending)
        return [*outputs, *self._advance(now_ns)]

    def _not_admitted(
        self, queue: SensorQueue, frame_id: FrameId, judged: Judged, message: schemas.Detections
    ) -> list[Output]:
        """Count and report a frame that has no place when it arrives."""
        judged_by, decision, timeline = judged
        queue.timeline = timeline
        if self._timeline is judged_by is not timeline:
            self._follow(timeline)
        if queue.reuses_number(frame_id, schemas.encoded(message), decision):
            return self._refuse(self._problems.reused_number(frame_id, decision.place.jump_ns))
        return self._refused(frame_id, decision)

    def _reinstate(self, frame_id: FrameId) -> list[Output]:
        """Go on with the publisher of a frame, which another one has succeeded."""
        outputs = self.flush()
        if not self._fused:
            self._begin(self._window.head)  # in the window publishers follow each other by their first frames
        self._follow(self._timeline.reinstated(frame_id))
        return outputs

    def _advance(self, now_ns: int | None) -> list[Output]:
        """Process the frames that are ready, in order, `Policy.at_once` of them at most.

        Args:
            now_ns: monotonic time; None: all pending frames are ready. All are processed then, within `FLUSH_NS`;
                those left are refused.
        """
        if now_ns is not None:
            self._now_ns = now_ns
            self.arrivals.end_at_deadline(now_ns)
        outputs: list[Output] = []
        self._has_ready, taken = False, 0
        ends_ns = time.perf_counter_ns() + FLUSH_NS if now_ns is None else None
        while pending := self._queues.take(now_ns, self._until_ns):
            outputs += self._process(pending)
            taken += 1
            if ends_ns is not None and time.perf_counter_ns() >= ends_ns:
                return [*outputs, *self._refuse_pending()]
            if ends_ns is None and taken >= self._policy.at_once and not self._queues.is_full:
                self._has_ready = self.held > 0
                break
        return outputs

    def _process(self, pending: PendingFrame) -> list[Output]:
        """Put a frame in its place."""
        began_ns, frame_id = time.perf_counter_ns(), pending.frame_id
        judged_by, decision, timeline = pending.judged
        if judged_by is not self._timeline:  # others were pending when it came
            decision, timeline = self._timeline.judge(frame_id)
            if not decision.verdict.admitted:
                self._timeline = timeline
                return self._refused(frame_id, decision)
        frame = ProcessedFrame(frame_id, pending.detections, pending.points, pending.missed, 0, [], decision.place)
        if decision.last:
            outputs = self._step([frame], timeline, frame_id, pending.ticket, began_ns, pending.inputs)
            return [*outputs, *self._refuse_ahead()] if self.held else outputs
        return self._step(self._window.inserted(frame, timeline.places()), timeline, frame_id, pending.ticket, began_ns)

    def _refuse_ahead(self) -> list[Output]:
        """Refuse the first frame of each sensor that is ahead, as another one goes on; those after it follow it."""
        outputs: list[Output] = []
        for queue in self._queues.values():
            timeline = self._timeline
            if queue.held and isinstance(timeline, FusedTimeline) and timeline.is_ahead(queue.held[0].frame_id):
                frame_id = queue.pop().frame_id
                decision, doubted = timeline.doubted(frame_id)
                self._follow(doubted)
                outputs += self._refused(frame_id, decision)
        return outputs

    def _amend(self, message: schemas.Points, frame_id: FrameId, ticket: Any) -> list[Output]:
        """Put a cloud that came after its frame into the window."""
        began_ns, frames = time.perf_counter_ns(), self._window.frames
        placed = self._window.amended(message, frame_id, published=self._timeline.knows(frame_id))
        if all(new is old for new, old in zip(placed, frames, strict=True)):
            return []
        return self._step(placed, self._timeline, frame_id, ticket, began_ns)

    def _step(
        self,
        placed: list[ProcessedFrame],
        timeline: Timeline,
        frame_id: FrameId,
        ticket: Any,
        began_ns: int,
        inputs: Inputs | None = None,
    ) -> list[Output]:
        """Process frames from the first that is not as it was; when a step raises, the sensor is quarantined.

        Args:
            placed: the frames of the window as they are to be; with `inputs` one that belongs behind all others.
            timeline: that with these frames.
            frame_id: the frame that is new.
            ticket: its ticket.
            began_ns: when this began.
            inputs: the new frame, decoded; None: frames are inserted or changed.
        """
        window = self._window
        before, final = window.head.session, window.base.reached
        try:
            outcomes = window.redo(placed) if inputs is None else window.append(placed[0], inputs)
        except Exception as error:  # noqa: BLE001 - a fault in one session's step must not end the others
            return self._fail(error, placed if inputs is None else [*window.frames, *placed], frame_id)
        gone = window.trim(self._policy)
        self._follow(timeline.settle(window.base, gone) if gone else timeline, gone)
        self._deliveries.inserted += inputs is None
        outputs = [] if self.session == before else self._restarted(outcomes)
        if self.parameters.sensor_motion and self._estimated != self.session and self.density.sensor_motion is not None:
            self._estimated = self.session
            outputs.append(self._problems.no_pose(frame_id, self.density.sensor_motion))
        step_ns = (time.perf_counter_ns() - began_ns) // max(1, len(outcomes))
        for one in outcomes:
            if (one.unknown or one.fault or one.tracks is None) and not one.frame.revision:
                outputs += self._problems.left_out(one, self.parameters)
            if (tracks := one.tracks) is not None:
                self._deliveries.corrected += one.frame.revision > 0
                tracks.ticket, tracks.step_ns, tracks.run, tracks.final = ticket, step_ns, self.run, final
                outputs.append(tracks)
        return outputs

    def _fail(self, error: Exception, placed: list[ProcessedFrame], frame_id: FrameId) -> list[Output]:
        """Quarantine the sensor; the frame that failed and the pending ones go, unprocessed."""
        queue = self._queues[frame_id.sensor]
        reason = queue.quarantine = f"{type(error).__name__}: {error}"[:MAX_ERROR]
        came = len(placed) - len(self._window.frames)  # none with a late cloud, whose numbers are no frame's
        self._deliveries.refused += came + queue.clear()
        self._follow(self._timeline.note(frame_id) if came else self._timeline)
        dump = self._window.transition.dump(self._window.base, placed, error)
        problem = self._problems.of("internal", frame_id, "", "a step of the tracker without an error", reason)
        return [problem, Quarantined(reason, dump)]

    def _begin(self, state: FilterState, transition: Transition | None = None) -> None:
        """Begin the window with a state when no frame is pending, with another transition when the profile changes."""
        self._window = ReorderWindow(state, transition or self._window.transition)
        self._follow(self._timeline.settle(state, self._timeline.frame_ids))

    # Problems

    def _refused(self, frame_id: FrameId, decision: Decision) -> list[Output]:
        """Count and report a frame that has no place; of a duplicate there is nothing to report."""
        if decision.verdict is Verdict.DUPLICATE:
            self._deliveries.duplicates += 1
            return []
        if decision.verdict is Verdict.LATE:
            self._deliveries.late += 1
        else:
            self._deliveries.refused += 1
        return [self._problems.refused(frame_id, decision)]

    def _restarted(self, outcomes: Sequence[Outcome]) -> list[Output]:
        """Report the session id that frames started, the last one if there were several."""
        for one in reversed(outcomes):
            if (begun := one.begun) is not None:
                if begun.reason == "first":
                    return [begun]
                return [begun, self._problems.restarted(one.frame.frame_id, begun)]
        return []

    def _refuse_pending(self) -> list[Output]:
        """Refuse all pending frames, with a problem for each sensor: there was no time to process them."""
        problems: list[Output] = []
        expected = f"at most {FLUSH_NS / SECOND:g} s for all frames that waited"
        for one in self._queues.values():
            if one.held:
                first, count = one.held[0].frame_id, one.clear()
                self._deliveries.refused += count
                problems.append(self._problems.of("overload", first, "", expected, "more", count))
        self._follow(self._timeline)
        return problems

    def _refuse(self, problem: schemas.Problem) -> list[Output]:
        """Count a frame as refused, and report it."""
        self._deliveries.refused += 1
        return [problem]
