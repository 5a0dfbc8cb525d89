"""One session: the density of one stream and what decides about it. No I/O, no threads, no clock of its own.

Conventions: `now_ns` is the local monotonic clock, handed in by the caller and used for nothing but waiting for point
clouds; everything else follows from the messages. So the same messages in the same order give the same tracks, byte for
byte. Frames are processed one by one in the order that `timing` gives them; a frame that cannot be processed changes
nothing but the counters.

A session id names one life of the density. It is derived from the stream, the frame at which that life began and the
parameters, so that a repeated run gives it again, and a service that was restarted and went on with another frame does
not.
"""

from __future__ import annotations

import hashlib
import json
import time
from bisect import insort
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Self

import optipmb_schemas as schemas

import optipmb
from optipmb_service import convert
from optipmb_service.checkpoint import Checkpoint
from optipmb_service.clouds import Clouds
from optipmb_service.problems import problem_of
from optipmb_service.records import SECOND, Begun, Counters, Life, Output, Policy, RefusedError, Steps, Tracked
from optipmb_service.timing import Decision, Mark, Timeline, Verdict, hold_until

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_HELD: Final = 64
"""Frames held for their clouds at once; beyond it the oldest goes on without."""

MAX_LABELS: Final = 256
"""Unknown class names remembered as reported."""


@dataclass(frozen=True, slots=True)
class _Held:
    message: schemas.Detections
    mark: Mark
    decision: Decision
    deadline_ns: int | None
    ticket: Any

    @property
    def order(self) -> tuple[int, int, int]:
        return self.decision.era, self.mark.stamp_ns, self.mark.seq


@dataclass(slots=True)
class _Cell:
    """The parts that a restart replaces together."""

    density: optipmb.Density
    session: str
    generation: int
    tracks: int = 0
    reported: set[str] = field(default_factory=set)


class Session:
    """The state of one stream.

    Args:
        stream: `site/node/sensor`.
        parameters: the profile to track with.
        policy: waiting and restarting.
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
        instance: str = "",
        life: Life | None = None,
        tracker: Callable[[optipmb.Parameters], Steps] = optipmb.Tracker,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> None:
        self.stream = stream
        self.counters = Counters()
        self._policy = policy or Policy()
        self._instance = instance
        self._clock = clock
        self._make = tracker
        self._timeline = Timeline(self._policy.gap_limit_ns)
        self._held: list[_Held] = []
        self._clouds = Clouds(self._policy.clouds)
        self._last: Mark | None = None
        self._recovery_ns: int | None = None
        life = life or Life()
        self._starts = life.starts
        self._use(parameters)
        self._cell = _Cell(optipmb.Density.empty(life.next_id), self._name(None, life.starts), generation=0)

    # What arrives

    def on_detections(
        self, message: schemas.Detections, now_ns: int, *, arrived_ns: int | None = None, ticket: Any = None
    ) -> list[Output]:
        """Take a frame; returns what became ready by it, which may be nothing, this frame or frames held before it.

        Args:
            message: the frame.
            now_ns: monotonic time.
            arrived_ns: when the frame arrived, if before now: its wait for a cloud began then.
            ticket: comes back with the tracks of the frame.
        """
        mark = Mark(message.epoch, message.seq, message.stamp_ns)
        before = self._timeline
        decision, self._timeline = before.judge(mark)
        if not decision.verdict.admitted:
            return self._refuse(mark, decision)
        if decision.verdict in (Verdict.NEW_EPOCH, Verdict.RESTART):
            self.counters.new_epochs += 1
            if mark.epoch != before.epoch:
                self._clouds.forget_publisher(before.epoch or b"")
        deadline_ns = hold_until(
            has_points=message.has_points,
            stamp_ns=mark.stamp_ns,
            arrived_ns=now_ns if arrived_ns is None else arrived_ns,
            newest_cloud_ns=self._clouds.newest_ns,
            cloud_wait_ns=self._policy.cloud_wait_ns,
            cloud_memory_ns=self._policy.cloud_memory_ns,
        )
        insort(self._held, _Held(message, mark, decision, deadline_ns, ticket), key=lambda held: held.order)
        return self._advance(now_ns)

    def on_points(self, message: schemas.Points, now_ns: int) -> list[Output]:
        """Take a cloud; returns what waited for it."""
        self._clouds.add(message)
        return self._advance(now_ns)

    def on_tick(self, now_ns: int) -> list[Output]:
        """Return what need not wait any longer."""
        return self._advance(now_ns)

    @property
    def deadline_ns(self) -> int | None:
        """When `on_tick` is due (monotonic, ns); None while nothing is held."""
        return self._held[0].deadline_ns if self._held else None

    @property
    def held(self) -> int:
        """Frames waiting for their clouds."""
        return len(self._held)

    # Commands

    def flush(self) -> list[Output]:
        """Process what is held, without waiting for its clouds any longer."""
        return self._advance(None)

    def reset(self, reason: str = "reset") -> list[Output]:
        """Forget the density and begin anew; frames seen before stay seen, track ids go on."""
        outputs = self.flush()
        self._starts += 1
        empty = optipmb.Density.empty(self._cell.density.next_id)
        self._cell = _Cell(empty, self._name(self._last, self._starts), self._cell.generation)
        return [*outputs, Begun(self._cell.session, reason)]

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
            self._policy = replace(self._policy, cloud_wait_ns=round(cloud_wait_s * SECOND))
        if parameters is not None and changes:
            self._use(parameters)
        if restart:
            outputs += self.reset("parameters")
        elif changes:
            self._cell.session = self._name(None, self._starts)
        return outputs

    # What it is

    @property
    def session(self) -> str:
        """The id of the present life of the density."""
        return self._cell.session

    @property
    def density(self) -> optipmb.Density:
        """The density after the last frame."""
        return self._cell.density

    @property
    def cloud_wait_s(self) -> float:
        """The longest wait for a cloud."""
        return self._policy.cloud_wait_ns / SECOND

    @property
    def life(self) -> Life:
        """What a later session of the stream has to know."""
        return Life(self._starts, self._cell.density.next_id)

    def snapshot(self) -> Checkpoint:
        """Return the state between two frames, as references to values that never change: cheap, to be encoded later.

        Frames that are held are not in it: they come again from the publisher's cache.
        """
        cell = self._cell
        return Checkpoint(
            self.stream,
            cell.session,
            self._starts,
            cell.generation,
            cell.tracks,
            self.parameters,
            cell.density,
            self._timeline,
            self._last,
            replace(self.counters, received=self.counters.received - len(self._held)),
        )

    @classmethod
    def restore(
        cls,
        checkpoint: Checkpoint,
        now_ns: int,
        policy: Policy | None = None,
        *,
        instance: str = "",
        tracker: Callable[[optipmb.Parameters], Steps] = optipmb.Tracker,
        clock: Callable[[], int] = time.perf_counter_ns,
    ) -> Self:
        """Return the session that a checkpoint was taken of. It is `recovering` until `recovered` is called.

        Args:
            checkpoint: its state.
            now_ns: monotonic time; the waiting for missed frames begins now.
            policy: waiting and restarting.
            instance: name of the service, for problems.
            tracker: makes the tracker.
            clock: measures how long a step takes, ns.
        """
        session = cls(checkpoint.stream, checkpoint.parameters, policy, instance=instance, tracker=tracker, clock=clock)
        session._starts, session._timeline, session._last = checkpoint.starts, checkpoint.timeline, checkpoint.last
        session._cell = _Cell(checkpoint.density, checkpoint.session, checkpoint.generation, checkpoint.tracks)
        session.counters = replace(checkpoint.counters)
        session._recovery_ns = now_ns + session._policy.recovery_wait_ns
        return session

    @property
    def recovering(self) -> bool:
        """Whether frames behind a gap are held, because those missing may still come from the publisher's cache."""
        return self._recovery_ns is not None

    def recovered(self, now_ns: int) -> list[Output]:
        """End the waiting: all that the caches have is here. Returns what was held for it."""
        self._recovery_ns = None
        return self._advance(now_ns)

    def state(self, *, shed: int = 0, queue: int = 0, closed: bool = False) -> schemas.SessionState:
        """Return the state as the message that answers a query."""
        counters, density, last = self.counters, self._cell.density, self._last
        return schemas.SessionState(
            stream=self.stream,
            session=self._cell.session,
            state="closed" if closed else "running" if counters.frames else "new",
            profile=self.parameters.name,
            epoch=last.epoch if last else None,
            seq=last.seq if last else None,
            stamp_ns=last.stamp_ns if last else None,
            received=counters.received + shed + queue,
            frames=counters.frames,
            duplicates=counters.duplicates,
            late=counters.late,
            refused=counters.refused,
            shed=counters.shed + shed,
            gaps=counters.gaps,
            new_epochs=counters.new_epochs,
            clouds_used=counters.clouds_used,
            clouds_missed=counters.clouds_missed,
            clouds_refused=counters.clouds_refused,
            tracks=self._cell.tracks,
            bernoullis=len(density.bernoulli),
            poissons=len(density.poisson),
            next_id=density.next_id,
            queue=queue + len(self._held),
        )

    # The order of things

    def _advance(self, now_ns: int | None) -> list[Output]:
        """Process the frames that are ready, in order; None: all of them."""
        outputs: list[Output] = []
        while self._held:
            head = self._held[0]
            points = None if head.message.has_points is False else self._clouds.get(head.mark.stamp_ns)
            waits = points is None and head.deadline_ns is not None
            if waits and now_ns is not None and now_ns < (head.deadline_ns or 0) and len(self._held) <= MAX_HELD:
                break
            del self._held[0]
            self.counters.clouds_missed += waits
            outputs += self._process(head, points)
        return outputs

    def _process(self, held: _Held, points: schemas.Points | None) -> list[Output]:
        """Step the density by one frame; whatever fails leaves everything but the counters as it was."""
        began_ns = self._clock()
        mark, old = held.mark, self._cell
        self._clouds.forget_until(mark.stamp_ns, self._policy.gap_limit_ns)
        gap, timeline = self._timeline.release(mark, held.decision.era)
        anew = held.decision.generation != old.generation
        begins = anew or self._last is None
        density = optipmb.Density.empty(old.density.next_id) if anew else old.density
        session = self._name(mark, self._starts + 1) if begins else old.session
        try:
            frame, ignored = convert.frame_of(self.parameters, held.message, points)
            result = self._tracker.step(density, frame)
            used = bool(result.diagnostics.cloud_used)
            tracks = convert.tracks_of(
                result.tracks,
                stream=self.stream,
                mark=mark,
                session=session,
                parameters=self.parameters,
                cloud_used=used,
                gap=gap,
                ignored=ignored,
            )
        except optipmb.FrameError as error:
            self.counters.refused += 1
            return [self._problem("invalid_value", error.path, error.expected, error.received, mark)]
        except Exception as error:  # noqa: BLE001 - a fault in one session's step must not end the others
            self.counters.refused += 1
            received = f"{type(error).__name__}: {error}"
            return [self._problem("internal", "", "a step of the tracker without an error", received, mark)]
        outputs: list[Output] = []
        if begins:
            reason = "first" if self._last is None else "publisher" if mark.epoch != self._last.epoch else "jump"
            outputs.append(Begun(session, reason, held.decision.jump_ns))
            self._starts += 1
            self._cell = _Cell(result.density, session, held.decision.generation)
        self._timeline, self._last = timeline, mark
        self._cell.density, self._cell.tracks = result.density, len(tracks.id)
        self.counters.frames += 1
        self.counters.gaps += gap
        self.counters.clouds_used += used
        outputs += self._unknown(held) if ignored else ()
        outputs.append(Tracked(tracks, held.ticket, self._clock() - began_ns))
        return outputs

    def _use(self, parameters: optipmb.Parameters) -> None:
        self.parameters = parameters
        self._tracker = self._make(parameters)
        values = json.dumps(parameters.model_dump(mode="json"))
        self._digest = hashlib.blake2b(values.encode(), digest_size=16).digest()

    def _name(self, mark: Mark | None, starts: int) -> str:
        digest = hashlib.blake2b(self._digest, digest_size=16, person=b"optipmb-session")
        where = (mark.epoch.hex(), mark.seq, mark.stamp_ns) if mark else ()
        digest.update(json.dumps([self.stream, starts, *where]).encode())
        return digest.hexdigest()

    # Problems

    def _refuse(self, mark: Mark, decision: Decision) -> list[Output]:
        if decision.verdict is Verdict.DUPLICATE:
            self.counters.duplicates += 1
            return []
        if decision.verdict is Verdict.RETIRED:
            self.counters.refused += 1
            expected = "the newest publisher of the stream; an earlier one still sends"
            return [self._problem("duplicate_epoch", "epoch", expected, mark.epoch.hex(), mark)]
        self.counters.late += 1
        expected = "a frame after the last one processed"
        return [self._problem("late", "stamp_ns", expected, f"{decision.jump_ns / SECOND:+.3f} s", mark)]

    def _unknown(self, held: _Held) -> list[Output]:
        problems: list[Output] = []
        for label, count in convert.unknown_labels(self.parameters, held.message).items():
            if label in self._cell.reported or len(self._cell.reported) >= MAX_LABELS:
                continue
            self._cell.reported.add(label)
            expected = f"one of {', '.join(self.parameters.classes)} (profile {self.parameters.name})"
            problem = self._problem("unknown_class", "labels", expected, repr(label), held.mark)
            problems.append(problem.model_copy(update={"count": count}))
        return problems

    def _problem(self, code: str, path: str, expected: str, received: str, mark: Mark) -> schemas.Problem:
        return problem_of(
            code,
            stream=self.stream,
            instance=self._instance,
            path=path,
            expected=expected,
            received=received,
            message=f"Frame {mark.seq}: {path or 'tracker'}: expected {expected}, received {received}.",
            seq=mark.seq,
            stamp_ns=mark.stamp_ns,
        )
