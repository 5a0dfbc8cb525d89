"""One session: what decides about the messages of a stream, or of several sensors that feed one density.

No I/O, no threads, no clock of its own.

Conventions: `now_ns` is the local monotonic clock, handed in by the caller and used for nothing but waiting, for point
clouds and, after a restore, for frames that were missed; everything else follows from the messages. So the same
messages give the same tracks, byte for byte, and those of the window give the same state in whatever order they come.

The parts: `sensor_queues` holds the frames of each sensor until they are ready, `recovery` those for which caches may
fill a gap; `frame_steps` takes them through the tracker, `processed` has those that were gone through, and `reporting`
says and counts what became of them. Here are what arrives, commands, and what is written down.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

import optipmb_schemas as schemas

import optipmb
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import Checkpoint
from optipmb_service.session.configuration import Configuration, profile_of, wait_of
from optipmb_service.session.frame_steps import FrameSteps
from optipmb_service.session.processed import ProcessedFrames
from optipmb_service.session.recovery import Recovery
from optipmb_service.session.reporting import SessionReporting
from optipmb_service.session.sensor_queues import SensorQueues
from optipmb_service.session.state import Contents
from optipmb_service.session.timeline import FrameId
from optipmb_service.session.values import SECOND, Begun, Counters, Lineage, Output, Policy, total

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb_service.session.reporting import Condition
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
        life = life or Lineage()
        self._settings = Configuration(stream, policy or Policy(), tracker, fused=fused)
        policy = self._settings.policy
        self._reporting = SessionReporting(stream, instance, policy)
        self._processed = ProcessedFrames(self._settings.transition(parameters), policy, life, fused=fused)
        self._sensors = SensorQueues(policy, self._processed)
        self._recovery = Recovery(policy, self._processed, self._sensors)
        self._steps = FrameSteps(self._processed, self._sensors, self._recovery, self._reporting, life.run, clock)
        self._restored = False
        if not fused:
            self._sensors.of("")

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
        pending = self._sensors.of(frame_id.sensor)
        if pending is None:
            self._reporting.deliveries.refused += 1
            return [self._reporting.complain.too_many(frame_id)]
        if error := self._sensors.quarantine.get(frame_id.sensor):
            if self._processed.timeline.knows(frame_id):
                self._reporting.deliveries.refused += 1
                return [self._reporting.complain.quarantined(frame_id, error)]
            outputs += self._released(frame_id.sensor)
        begins = self._fused and not (self._restored or self.counters.frames or self._recovery.began)
        if begins and self._settings.policy.recovery_wait_ns:
            self._recovery.begin(frame_id, now_ns if arrived_ns is None else arrived_ns, now_ns)
        judged_by = pending.timeline
        decision, arrived = judged_by.judge(frame_id)
        if pending.is_alive(frame_id, decision):
            outputs += self.flush()
            self._processed.reinstate(frame_id)
            self._sensors.begin_anew()
            judged_by = pending.timeline
            decision, arrived = judged_by.judge(frame_id)
        if not decision.verdict.admitted:
            self._sensors.remember(pending, judged_by, arrived)
            if pending.reuses_number(message, decision):
                self._reporting.deliveries.refused += 1
                return [*outputs, self._reporting.complain.reused(frame_id, decision.place.jump_ns)]
            return [*outputs, *self._reporting.refused(frame_id, decision)]
        pending.checksums.add(frame_id.epoch, frame_id.seq, schemas.encoded(message))
        try:
            frame, ignored = convert.frame_of(self.parameters, message)
        except optipmb.FrameError as invalid:
            self._reporting.deliveries.refused += 1
            self._processed.note(frame_id)
            pending.timeline = judged_by.note(frame_id)
            self._sensors.follow()
            return [*outputs, self._reporting.complain.invalid(frame_id, invalid)]
        pending.timeline = arrived
        since_ns = now_ns if arrived_ns is None else arrived_ns
        if found := pending.stamps.add(frame_id.stamp_ns, since_ns):
            outputs.append(self._reporting.complain.clock(frame_id, found))
        contents = Contents(message, frame, ignored)
        held = pending.arrived(contents, frame_id, since_ns, ticket, (judged_by, decision, arrived))
        return [*outputs, *self._steps.accept(held, pending, now_ns)]

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
        pending = self._sensors.of(frame_id.sensor)
        if pending is None:
            return [self._reporting.complain.too_many(frame_id)]
        pending.clouds.add(message)
        amends = self._settings.policy.late_clouds and frame_id.sensor not in self._sensors.quarantine
        outputs = self._steps.amend(message, frame_id, ticket) if amends else []
        return [*outputs, *self._steps.advance(now_ns)]

    def on_tick(self, now_ns: int) -> list[Output]:
        """Return what need not wait any longer."""
        return self._steps.advance(now_ns)

    @property
    def deadline_ns(self) -> int | None:
        """When `on_tick` is due (monotonic, ns), 0: at once; None while nothing is held."""
        return 0 if self._steps.has_ready else self._sensors.deadline_ns(self._recovery.complete_until)

    def refuse(self) -> None:
        """Count a message of the stream that was none."""
        self._reporting.deliveries.refused += 1

    # Commands

    def flush(self) -> list[Output]:
        """Process what is held, without waiting any longer."""
        return self._steps.advance(None)

    def reset(self, reason: str = "reset") -> list[Output]:
        """Forget the density and begin anew; frames seen before stay seen, track ids go on, a quarantine ends."""
        outputs = self.flush()
        self._sensors.quarantine.clear()
        self._processed.begin_anew()
        self._sensors.begin_anew()
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
        before, cloud_wait_ns = self.parameters, wait_of(cloud_wait_s)
        wanted, changes = profile_of(before, parameters, horizons, frames=self.counters.frames, restart=restart)
        outputs = self.flush() if changes else []
        if cloud_wait_ns is not None:
            self._wait(cloud_wait_ns)
        if changes:
            # Frames are given to the tracker by the classes of the old profile: they cannot be gone over again.
            self._processed.begin(self._processed.head, self._settings.transition(wanted))
            self._sensors.begin_anew()
        elif wanted != before:
            self._processed.report_by(self._settings.transition(wanted))
        if restart:
            outputs += self.reset("parameters")
        elif changes:
            self._processed.empty()
            self._sensors.begin_anew()
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
            cloud_wait_ns=self._settings.cloud_wait_ns,
            quarantine=dict(self._sensors.quarantine),
            seen=self._processed.timeline.seen,
            base=base,
            window=window,
            head=self._processed.head,
            deliveries=replace(self._reporting.deliveries),
            newest_cloud_ns=self._sensors.newest_cloud_ns(),
            run=self._steps.run,
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
        if checkpoint.cloud_wait_ns is not None:
            session._wait(checkpoint.cloud_wait_ns)
        session._reporting.deliveries = replace(checkpoint.deliveries)
        session._recovery.resume(checkpoint, now_ns)
        session._restored = True
        session._processed.resume(checkpoint)
        session._sensors.resume(checkpoint)
        session._steps.run = total(checkpoint.run, fence)
        return session

    @property
    def recovering(self) -> bool:
        """Whether frames behind a gap are held, because those missing may still come from the publisher's cache."""
        return self._recovery.behind_gap

    @property
    def awaits_caches(self) -> bool:
        """Whether frames are held because others before them, or of other sensors, may still come from caches."""
        return self._sensors.recovery_ns is not None

    @property
    def young_since_ns(self) -> int | None:
        """Since when, monotonic, it `awaits_caches`, if it began so lately that it may not know all its sensors."""
        return self._recovery.young_since_ns

    @property
    def sensors(self) -> set[str]:
        """The sensors that it knows of, by stream; of one stream an empty name."""
        return set(self._sensors.pending)

    def recovered(self, now_ns: int) -> list[Output]:
        """End the waiting: all that the caches had is here. Returns what was held for it."""
        self._recovery.end()
        return self._steps.advance(now_ns)

    def unprocessed(self) -> list[tuple[schemas.Detections | schemas.Points, Any]]:
        """Return what came and is in no snapshot: clouds without their frame, and frames held, each with its ticket."""
        return self._sensors.unprocessed()

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

        A frame that was tracked before a crash may be tracked again after it, with others that were missing then, and
        nobody knows any more under which revision it was published. What a later run publishes holds.
        """
        return self._steps.run

    @property
    def held(self) -> int:
        """Frames that wait; may be called by any thread."""
        return self._sensors.held

    @property
    def held_bytes(self) -> int:
        """Bytes of the messages that are kept: frames that wait, clouds, and the window; nearly, for any thread."""
        return self._sensors.kept_bytes()

    @property
    def quarantine(self) -> str:
        """The error for which frames are refused, of any sensor; empty while none are."""
        return next(iter(self._sensors.quarantine.values()), "")

    @property
    def cloud_wait_s(self) -> float:
        """The longest wait for a cloud."""
        return self._settings.policy.cloud_wait_ns / SECOND

    @property
    def life(self) -> Lineage:
        """What a later session of the stream has to know."""
        head = self._processed.head
        return Lineage(head.starts, head.density.next_id, self._steps.run)

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
        if self._sensors.quarantine and self._sensors.quarantine.keys() >= self._sensors.pending.keys():
            return "quarantined"
        if self.recovering:
            return "recovering"
        return "running" if self.counters.frames else "new"

    def _released(self, sensor: str) -> list[Output]:
        """End the quarantine of a sensor whose publisher was started anew; the density of others goes on."""
        if not self._fused:
            return self.reset("quarantine")
        del self._sensors.quarantine[sensor]
        return []

    def _wait(self, cloud_wait_ns: int) -> None:
        self._settings.wait(cloud_wait_ns)
        self._sensors.wait_by(self._settings.policy)

    def _frame_id(self, message: schemas.Detections | schemas.Points) -> FrameId:
        return FrameId(message.epoch, message.seq, message.stamp_ns, message.stream if self._fused else "")
