"""Processing of one frame: from one state of a session to the next, and the tracks of the frame.

It is a pure function of state, frame and parameters, so frames can be processed again when one is inserted before them.
When a step raises, nothing has changed.

A session id names one incarnation of the density. It is derived from the stream, the first frame of the incarnation,
the parameters, and the settings `sensors` and `rejoin`: a repeated run gives it again, and a service that was restarted
without its checkpoints and went on with another frame does not. When a late frame turns out to be the first one, the
incarnation gets the id that it would have had in order; tracks that were published under the other id are corrected
like all others behind that frame.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import platform
import traceback
from contextlib import suppress
from dataclasses import fields, replace
from importlib.metadata import version
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import optipmb_schemas as schemas

import optipmb
from optipmb.model.rows import record
from optipmb.world.zones import Shapes, ZoneState, adapted, end, observe
from optipmb_service.session import convert
from optipmb_service.session.counts import FrameCounts, total
from optipmb_service.session.outputs import Begun
from optipmb_service.session.policy import MAX_SENSORS
from optipmb_service.session.state import MAX_LABELS, FilterState, PoseHistory, SensorState
from optipmb_service.session.timeline import JUMP_FRAMES, FrameId, Verdict
from optipmb_service.session.worlds import in_one_world, relocated
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from optipmb.world.zones import Event
    from optipmb_service.session.outputs import Reason, TrackedFrame
    from optipmb_service.session.policy import Policy
    from optipmb_service.session.state import Inputs, Position, ProcessedFrame
    from optipmb_service.session.worlds import Relocated

GIVE_UP_NS: Final = SECOND
"""Sensor time after which a density that makes every frame too much is given up."""

MAX_TRACE: Final = 100_000

_COUNTS: Final = tuple(field.name for field in fields(FrameCounts))
_counts_in: Final = attrgetter(*_COUNTS)
_OPENING: Final = frozenset({Verdict.NEW_EPOCH, Verdict.RESTART})


@record
class Outcome:
    """Outcome of processing a frame.

    Attributes:
        frame: the frame.
        tracks: its tracks; None: it was refused.
        begun: the session id that it starts, if any.
        unknown: the classes that the profile lacks, with the number of objects of each, when not reported before.
        effort: why the frame was refused, when it needs more computing than a frame may.
        fault: of its relocation, or why its vectors are refused.
    """

    frame: ProcessedFrame
    tracks: TrackedFrame | None = None
    begun: Begun | None = None
    unknown: dict[str, int] | None = None
    effort: optipmb.EffortError | None = None
    fault: optipmb.FrameError | None = None


class Transition:
    """Steps the sessions of one stream with one profile.

    Args:
        stream: `site/node/sensor`.
        parameters: the profile.
        tracker: makes what steps the density.
        policy: where a sensor can be, and how its frames are used.
    """

    def __init__(
        self,
        stream: str,
        parameters: optipmb.Parameters,
        tracker: Callable[..., optipmb.Tracker],
        policy: Policy,
    ) -> None:
        self.stream = stream
        self.parameters = parameters
        joining = {} if policy.rejoin is None else {"rejoin": policy.rejoin}
        self._make: Callable[..., optipmb.Tracker] = functools.partial(tracker, **joining)
        self._trackers = [(parameters, self._make(parameters))]
        """Trackers with their parameters: of the profile, and of sensors that differ."""
        self._of: dict[str, int] = {}
        """Index of the tracker of each sensor, where some differ."""
        self._policy = policy
        self._shapes = Shapes.of(policy.zones)
        values = json.dumps(parameters.model_dump(mode="json", exclude={"horizons"}))  # no track depends on them
        if policy.sensors.shown():
            values += repr(policy.sensors)
        if policy.rejoin is not None:
            values += repr(policy.rejoin)
        self._digest = hashlib.blake2b(values.encode(), digest_size=16).digest()

    def name(self, frame_id: FrameId | None, starts: int) -> str:
        """Return the id of an incarnation that begins with or after a frame."""
        digest = hashlib.blake2b(self._digest, digest_size=16, person=b"optipmb-session")
        where = [frame_id.epoch.hex(), frame_id.seq, frame_id.stamp_ns] if frame_id else []
        if frame_id and frame_id.sensor:
            where.append(frame_id.sensor)
        digest.update(json.dumps([self.stream, starts, *where]).encode())
        return digest.hexdigest()

    def parameters_of(self, sensor: str) -> optipmb.Parameters:
        return self._used(sensor)[0]

    def _used(self, sensor: str) -> tuple[optipmb.Parameters, optipmb.Tracker]:
        """Return parameters and tracker of the frames of a sensor."""
        if not self._policy.sensors.uses:
            return self._trackers[0]
        if (index := self._of.get(sensor)) is None:
            parameters = self._policy.sensors.parameters(self.parameters, sensor)
            known = [one for one, _ in self._trackers]
            if parameters not in known:
                self._trackers.append((parameters, self._make(parameters)))
                known.append(parameters)
            if len(self._of) >= MAX_SENSORS:
                self._of.clear()
            index = self._of[sensor] = known.index(parameters)
        return self._trackers[index]

    def no_objects(self, next_id: int) -> optipmb.Density:
        return optipmb.Density.empty(self.parameters.labels, next_id)

    def step(
        self, before: FilterState, frame: ProcessedFrame, inputs: Inputs | None = None
    ) -> tuple[FilterState, Outcome]:
        """Process a frame.

        Args:
            before: the state.
            frame: the frame.
            inputs: its detections as the tracker reads them; None: they are decoded here.

        Raises:
            Exception: any error of the tracker.
        """
        frame_id, place = frame.frame_id, frame.place
        if place.opens is Verdict.UNCONFIRMED:
            # Later frames are judged and ordered as if it had not been there.
            refused = _refused(before, frame, before.sensor(frame_id.sensor).pose_history, "unconfirmed")
            return replace(refused, last=before.last), Outcome(frame)
        if inputs is None:
            message = frame.message
            inputs = message, *convert.frame_of(self.parameters_of(frame_id.sensor), message)
        message, seen, ignored = inputs
        world = relocated(before, frame_id, message.relocation)
        if world.ahead:
            try:
                seen, ignored = convert.frame_of(self.parameters_of(frame_id.sensor), message, world.ahead)
            except optipmb.FrameError as error:
                world = world._replace(ahead=None, fault=error)
        if world.ahead is None:
            history = before.sensor(frame_id.sensor).pose_history
            return _refused(world.state, frame, history, "astray"), Outcome(frame, fault=world.fault)
        if frame.points is not None and in_one_world(message, frame.points):
            seen = replace(seen, cloud=convert.cloud_of(frame.points, world.ahead))
        after, outcome = self._step(world.state, frame, (message, seen, ignored), world)
        if world.change == "moves" and outcome.tracks is not None:
            outcome.tracks.others["relocation"] = message.relocation
        return after, outcome if world.fault is None else replace(outcome, fault=world.fault)

    def _step(
        self, before: FilterState, frame: ProcessedFrame, inputs: Inputs, world: Relocated
    ) -> tuple[FilterState, Outcome]:
        """Process a frame in the world of the density."""
        frame_id, message = frame.frame_id, inputs[0]
        begun = self._begun(before, frame)
        moved = self.on_new_clock(before, frame, message)
        if moved is not None:
            before, begun = moved, self._begin(before, frame, "clock")
        if world.change == "restarts":
            begun = self._begin(before, frame, "world")
        sensor = before.sensor(frame_id.sensor)
        known = PoseHistory() if begun else sensor.pose_history
        pose_history, where = check_pose(known, message, self._policy, world.ahead or ())
        if where == "moved" and self._others_stayed(before, frame_id):
            # The sensors of a session move together: this one waits for the others to say the same.
            there, before_it = pose_history.position, sensor.pose_history
            pose_history = replace(
                before_it, astray=before_it.astray + 1, astray_ns=frame_id.stamp_ns, astray_position=there
            )
            where = "astray"
        if where == "astray":
            return _refused(before, frame, pose_history, "astray"), Outcome(frame)
        if where == "moved":
            begun = self._begin(before, frame, "pose")
        try:
            return self._track(before, frame, inputs, begun, pose_history)
        except optipmb.EffortError as error:
            # What the frame cannot be tracked with may be a density of too many objects: they are given up when they
            # have not been updated for so long, and the frame alone is not too much.
            silent_ns = frame_id.stamp_ns - before.density.stamp_ns
            if begun is None and before.density.stamp_ns >= 0 and silent_ns > GIVE_UP_NS:
                with suppress(optipmb.EffortError):
                    return self._track(before, frame, inputs, self._begin(before, frame, "effort"), pose_history)
            return _refused(before, frame, sensor.pose_history, "effort"), Outcome(frame, effort=error)
        except optipmb.FrameError as error:
            if error.path != "embedding":
                raise
            return _refused(before, frame, sensor.pose_history, "astray"), Outcome(frame, fault=error)

    def on_new_clock(
        self, before: FilterState, frame: ProcessedFrame, message: schemas.Detections | None = None
    ) -> FilterState | None:
        """Return the state with its stamps set back, if a frame starts an incarnation because the clock stepped back.

        The objects are where they were: for as long as the frames that agreed on the step took, they go on. None where
        the frame starts none, or its stamps or its sensor are too far from those before to say so.
        """
        sensor = before.sensor(frame.frame_id.sensor)
        cursor, last, history = sensor.cursor, before.last, sensor.pose_history
        same = last is not None and cursor.epoch == frame.frame_id.epoch and cursor.jumped > 0
        if not same or not begins_with(before, frame) or not -self._policy.gap_limit_ns <= frame.place.jump_ns < 0:
            return None
        stamp_ns = frame.frame_id.stamp_ns
        density = set_clock(before.density, max(0, stamp_ns - JUMP_FRAMES * (stamp_ns - cursor.jumped_ns)))
        if history.stamp_ns is not None:
            history = replace(history, stamp_ns=density.stamp_ns)
        if check_pose(history, message or frame.message, self._policy)[1] != "near":
            return None
        known = replace(sensor, pose_history=history)
        return replace(before, density=density, sensors=_sensors(before, frame.frame_id.sensor, known))

    def dump(self, base: FilterState, frames: Sequence[ProcessedFrame], error: Exception) -> bytes:
        """Return what `optipmb track --dump` replays to the same error.

        Args:
            base: the state before the window.
            frames: the window's and the failed one, in the order of processing.
            error: the exception.
        """
        dumped: list[schemas.DumpedFrame] = []
        state = base
        for frame in frames:
            anew = begins_with(state, frame)
            if (world := relocated(state, frame.frame_id, frame.message.relocation)).change == "moves":
                base, state, anew, dumped = world.state, world.state, False, []  # and one world
            if (moved := self.on_new_clock(state, frame)) is not None:
                base, state, anew, dumped = moved, moved, False, []  # a dump has one clock
            try:
                state, outcome = self.step(state, frame)
            except Exception:  # noqa: BLE001 - the very one
                dumped.append(schemas.DumpedFrame(frame.message, frame.points, anew))
                break
            if outcome.tracks is not None:
                begun = outcome.begun is not None and outcome.begun.reason not in {"first", "clock"}
                dumped.append(schemas.DumpedFrame(frame.message, frame.points, begun))
        return schemas.encode_dump(
            schemas.Dump(
                stream=self.stream,
                error=f"{type(error).__name__}: {error}",
                trace="".join(traceback.format_exception(error))[-MAX_TRACE:],
                versions={name: version(name) for name in ("optipmb", "numpy", "numba")}
                | {"python": platform.python_version()},
                parameters=self.parameters.model_dump(mode="json"),
                sensors=self._differing({frame.frame_id.sensor for frame in frames}),
                stamp_ns=base.density.stamp_ns,
                next_id=base.density.next_id,
                density=optipmb.bytes_of(base.density),
                frames=tuple(dumped),
            )
        )

    def _differing(self, sensors: set[str]) -> dict[str, dict[str, Any]]:
        """Return the parameters of the sensors that have others than the profile."""
        used = {name: self.parameters_of(name) for name in sorted(sensors)}
        return {name: one.model_dump(mode="json") for name, one in used.items() if one is not self.parameters}

    def _begin(self, before: FilterState, frame: ProcessedFrame, reason: Reason, jump_ns: int | None = None) -> Begun:
        return Begun(
            self.name(frame.frame_id, before.starts + 1), reason, frame.place.jump_ns if jump_ns is None else jump_ns
        )

    def _begun(self, before: FilterState, frame: ProcessedFrame) -> Begun | None:
        """Return the session id that a frame starts by its place, if any."""
        last, frame_id = before.last, frame.frame_id
        if last is None:
            return self._begin(before, frame, "first")
        if not begins_with(before, frame):
            return None
        if frame_id.sensor:
            return self._begin(before, frame, "jump", frame_id.stamp_ns - last.stamp_ns)
        return self._begin(before, frame, "publisher" if frame_id.epoch != last.epoch else "jump")

    def _others_stayed(self, before: FilterState, frame_id: FrameId) -> bool:
        """Return whether another sensor of the session is where it was, as far as was heard lately."""
        return any(
            one.pose_history.stamp_ns is not None
            and not one.pose_history.astray
            and abs(frame_id.stamp_ns - one.pose_history.stamp_ns) <= self._policy.gap_limit_ns
            for name, one in before.sensors.items()
            if name != frame_id.sensor
        )

    def _track(
        self,
        before: FilterState,
        frame: ProcessedFrame,
        inputs: Inputs,
        begun: Begun | None,
        pose_history: PoseHistory,
    ) -> tuple[FilterState, Outcome]:
        frame_id, (message, seen, ignored) = frame.frame_id, inputs
        if begun:
            keeps = begun.reason in {"first", "clock"}
            density = before.density if keeps else self.no_objects(before.density.next_id)
            before = before.begun_anew(density, begun.session)
        sensor = before.sensor(frame_id.sensor)
        density = before.density
        if sensor.tracked is None and density.rejoining is not None:
            density = replace(density, rejoining=density.rejoining.with_sensor(frame_id.stamp_ns))
        result = self._used(frame_id.sensor)[1].step(density, seen)
        used = bool(result.diagnostics.cloud_used)
        same = sensor.tracked is not None and sensor.tracked[0] == frame_id.epoch
        highest = sensor.tracked[1] if sensor.tracked is not None and same else frame_id.seq - 1
        gap = max(0, frame_id.seq - highest - 1)
        tracks = convert.tracks_of(
            result,
            self.stream,
            frame_id,
            session=before.session,
            revision=frame.revision,
            profile=self.parameters.name,
            cloud_used=used,
            gap=gap,
            ignored=ignored,
            **({"world": before.worlds.number} if before.worlds else {}),
            labels=self.parameters.labels,
        )
        zones, tracks.events = self._zones(before, result, frame_id.stamp_ns)
        tracks.known = convert.attributes_of(result.density, [one.id for one in tracks.events])
        second = None if before.last is None else before.last.stamp_ns // SECOND
        if (
            self._policy.zones
            and zones is not None
            and (frame.revision or begun or second != frame_id.stamp_ns // SECOND)
        ):
            tracks.counts = {one.name: zones.counts.get(one.name, {}) for one in self._policy.zones}
        unknown = self._unknown(message, sensor.reported) if ignored else {}
        more = {"repaired": int(result.diagnostics.repaired)}
        if result.joined is not None:
            more |= {"rejoined": result.joined.joins, "lost_dropped": result.joined.dropped}
        if message.embedding is not None:
            how = self._policy.rejoin
            more["embedding_ignored"] = int(how is None or how.embedding_model != message.embedding_model)
        known = SensorState(
            cursor=sensor.cursor.after(frame_id, frame.place),
            tracked=(frame_id.epoch, max(highest, frame_id.seq)),
            reported=sensor.reported | unknown.keys() if unknown else sensor.reported,
            pose_history=pose_history,
        )
        after = FilterState(
            density=result.density,
            session=before.session,
            starts=before.starts,
            generation=frame.place.generation,
            last=frame_id,
            tracks=int(np.count_nonzero(result.tracks.confirmed)),
            counts=_counted(before, frame, frames=1, gaps=gap, clouds_used=used, **more),
            sensors=_sensors(before, frame_id.sensor, known),
            zones=zones,
            worlds=before.worlds,
        )
        return after, Outcome(frame, tracks, begun, unknown)

    def _zones(
        self, before: FilterState, result: optipmb.StepResult, stamp_ns: int
    ) -> tuple[ZoneState | None, tuple[Event, ...]]:
        """Return the state of the zones after a frame, and its events."""
        zones = self._policy.zones
        ended: tuple[Event, ...] = ()
        if not zones:  # their numbers go on when they come back
            return before.zones and (
                ZoneState(numbers=before.zones.numbers) if before.zones.zones else before.zones
            ), ()
        state = adapted(zones, before.zones or ZoneState())
        if state.session != before.session:
            state, ended = end(zones, state)
            state = replace(state, session=before.session)
        labels, rejoin = self.parameters.labels, self._policy.rejoin
        joined = None if result.joined is None or rejoin is None else (result.joined.object, rejoin.gap_s)
        state, events = observe(zones, state, stamp_ns, result.tracks, labels, self._shapes, joined)
        return state, (*ended, *events)

    def _unknown(self, message: schemas.Detections, reported: frozenset[str]) -> dict[str, int]:
        found = convert.unknown_labels(self.parameters, message)
        new = sorted(found.keys() - reported)[: max(0, MAX_LABELS - len(reported))]
        return {label: found[label] for label in found if label in new}


def check_pose(
    before: PoseHistory, message: schemas.Detections, policy: Policy, ahead: Sequence[optipmb.Relocation] = ()
) -> tuple[PoseHistory, Literal["near", "astray", "moved"]]:
    """Check whether a sensor can be where a frame says it is.

    A pose that jumps by a hundred metres (a lost localisation, poses of another vehicle) would leave every track behind
    and give birth to as many: the frame is refused. When several frames in a row agree with each other about the new
    place, the sensor is there: the next of them starts a new incarnation of the session.

    Args:
        before: poses of the frames before it.
        message: the frame.
        policy: what a sensor can do.
        ahead: motions that bring the frame to the world of the poses.

    Returns:
        The poses with this frame, and whether the sensor is near where it was, astray (the frame is to be refused), or
        taken to have moved.
    """
    if message.pose is None or policy.max_speed <= 0:
        return before, "near"
    x, y, z = message.pose.translation.tolist()
    position = functools.reduce(lambda place, one: one.place(place), ahead, (x, y, z))
    stamp_ns = message.stamp_ns
    there = PoseHistory(stamp_ns, position)
    if before.stamp_ns is None or _near(before.stamp_ns, before.position, stamp_ns, position, policy):
        return there, "near"
    agrees = before.astray > 0 and _near(before.astray_ns, before.astray_position, stamp_ns, position, policy)
    astray = before.astray + 1 if agrees else 1
    if astray >= policy.astray_frames:
        return there, "moved"
    return replace(before, astray=astray, astray_ns=stamp_ns, astray_position=position), "astray"


def _near(stamp_ns: int, position: Position, then_ns: int, then: Position, policy: Policy) -> bool:
    reach = policy.pose_margin + policy.max_speed * abs(then_ns - stamp_ns) * 1e-9
    return math.dist(position, then) <= reach


def _refused(before: FilterState, frame: ProcessedFrame, pose_history: PoseHistory, count: str) -> FilterState:
    """Return the state after a frame that is refused and counted under a name of `FrameCounts`."""
    frame_id, sensor = frame.frame_id, before.sensor(frame.frame_id.sensor)
    after = replace(sensor, cursor=sensor.cursor.after(frame_id, frame.place), pose_history=pose_history)
    counts = _counted(before, frame, **{count: 1})
    return replace(before, last=frame_id, counts=counts, sensors=_sensors(before, frame_id.sensor, after))


def _sensors(before: FilterState, name: str, state: SensorState) -> dict[str, SensorState]:
    """Return the sensors after a frame of one; when there are too many, the one that was silent for longest goes."""
    sensors = {**before.sensors, name: state}
    if len(sensors) > MAX_SENSORS:
        others = [(one.cursor.generation, one.cursor.newest_ns, other) for other, one in before.sensors.items()]
        del sensors[min(one for one in others if one[2] != name)[2]]
    return sensors


def _counted(state: FilterState, frame: ProcessedFrame, **more: int) -> FrameCounts:
    """Return the counts with one more frame."""
    before, frame_id = state.counts, frame.frame_id
    # In a session of several sensors each has its epochs; how one follows another follows from the frames before.
    succeeds = bool(frame_id.sensor) and state.sensor(frame_id.sensor).cursor.epoch not in {None, frame_id.epoch}
    more |= {"new_epochs": frame.place.opens in _OPENING or succeeds, "clouds_missed": frame.missed}
    counts = list(_counts_in(before))
    for name, count in more.items():
        if count:
            at = _COUNTS.index(name)
            counts[at] = total(counts[at], count)
    return FrameCounts(*counts)


def set_clock(density: optipmb.Density, stamp_ns: int) -> optipmb.Density:
    """Return a density whose last frame has another stamp; its other stamps are as long ago, but not before 0."""
    if density.stamp_ns < 0:
        return density
    shift_ns = stamp_ns - density.stamp_ns

    def moved(rows: Any, *names: str) -> Any:
        return rows.replaced(**{name: np.maximum(getattr(rows, name) + shift_ns, 0) for name in names})

    return replace(
        density,
        stamp_ns=stamp_ns,
        bernoulli=moved(density.bernoulli, "born_ns", "seen_ns"),
        poisson=moved(density.poisson, "born_ns"),
        misses=None if density.misses is None else moved(density.misses, "missed_from_ns", "looked_ns"),
        rejoining=None,  # no object is of another session
    )


def begins_with(before: FilterState, frame: ProcessedFrame) -> bool:
    """Return whether the place of a frame makes it begin with an empty density."""
    return before.last is not None and frame.place.generation != before.generation
