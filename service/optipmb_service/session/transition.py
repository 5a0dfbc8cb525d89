"""One frame through the tracker: from one state of a session to the next, and the tracks in between.

A pure function of state, frame and parameters, so that frames can be gone through once more whenever one is put
between them. Whatever it raises, nothing has changed.

A session id names one life of the density. It is derived from the stream, the frame at which that life began and the
parameters, so that a repeated run gives it again, and a service that was restarted without its checkpoints and went on
with another frame does not. When a late frame turns out to be the first of a life, the life gets the id that it would
have had in order; the tracks that were published under the other are corrected like all others behind that frame.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

import optipmb
from optipmb.records import record
from optipmb_service.session import convert
from optipmb_service.session.frame_tracks import FrameTracks, tracks_of
from optipmb_service.session.pose_check import judge
from optipmb_service.session.state import Contents, Entry, FilterState, FrameCounts, PoseHistory, SensorState
from optipmb_service.session.timeline import JUMP_FRAMES, FrameId, Verdict
from optipmb_service.session.values import MAX_LABELS, MAX_SENSORS, SECOND, total

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.session.values import Policy, Steps

GIVE_UP_NS: Final = SECOND
"""Sensor time after which a density that makes every frame too much is given up."""

_OPENING: Final = frozenset({Verdict.NEW_EPOCH, Verdict.RESTART})


@dataclass(frozen=True, slots=True)
class SessionStart:
    """Why a life of the density begins with a frame.

    Attributes:
        reason: see `values.Begun`.
        jump_ns: how far the stamps jumped.
    """

    reason: Literal["first", "jump", "clock", "publisher", "pose", "effort"]
    jump_ns: int


@record
class Outcome:
    """What became of a frame.

    Attributes:
        entry: the frame.
        tracks: its tracks, without their delivery part; None: it was refused.
        begins: whether a life began with it.
        unknown: the classes that the profile lacks, with the number of objects of each, when not reported before.
        effort: why the frame was refused, when it needs more computing than a frame may.
    """

    entry: Entry
    tracks: FrameTracks | None
    begins: SessionStart | None
    unknown: dict[str, int]
    effort: optipmb.EffortError | None = None


class Transition:
    """Steps the sessions of one stream with one profile.

    Args:
        stream: `site/node/sensor`.
        parameters: the profile.
        tracker: steps the density.
        policy: where a sensor can be.
    """

    def __init__(self, stream: str, parameters: optipmb.Parameters, tracker: Steps, policy: Policy) -> None:
        self.stream = stream
        self.parameters = parameters
        self._tracker = tracker
        self._policy = policy
        values = json.dumps(parameters.model_dump(mode="json", exclude={"horizons"}))  # no track depends on them
        self._digest = hashlib.blake2b(values.encode(), digest_size=16).digest()

    def name(self, frame_id: FrameId | None, starts: int) -> str:
        """Return the id of a life that begins with or after a frame."""
        digest = hashlib.blake2b(self._digest, digest_size=16, person=b"optipmb-session")
        where = [frame_id.epoch.hex(), frame_id.seq, frame_id.stamp_ns] if frame_id else []
        if frame_id and frame_id.sensor:
            where.append(frame_id.sensor)
        digest.update(json.dumps([self.stream, starts, *where]).encode())
        return digest.hexdigest()

    def step(self, before: FilterState, entry: Entry, contents: Contents | None = None) -> tuple[FilterState, Outcome]:
        """Go on by one frame.

        Args:
            before: the state.
            entry: the frame.
            contents: what was read of it; None: it is read here.

        Raises:
            Exception: whatever the tracker raises.
        """
        frame_id, place = entry.frame_id, entry.place
        if place.opens is Verdict.UNCONFIRMED:
            # What comes after is judged, and put in order, as if it had not been there.
            passed = _passed(before, entry, before.sensor(frame_id.sensor).pose_history, unconfirmed=1)
            return replace(passed, last=before.last), Outcome(entry, None, None, {})
        if contents is None:
            message = entry.message
            contents = Contents(message, *convert.frame_of(self.parameters, message))
        begins = _begins(before, entry)
        moved = self.on_new_clock(before, entry, contents.message)
        if moved is not None:
            before, begins = moved, SessionStart("clock", place.jump_ns)
        sensor = before.sensor(frame_id.sensor)
        known = PoseHistory() if begins else sensor.pose_history
        pose_history, where = judge(known, contents.message, self._policy)
        if where == "moved" and self._others_stayed(before, frame_id):
            # The sensors of a session move together: this one waits for the others to say the same.
            count = sensor.pose_history.astray + 1
            there = pose_history.position
            pose_history = replace(
                sensor.pose_history, astray=count, astray_ns=frame_id.stamp_ns, astray_position=there
            )
            where = "astray"
        if where == "astray":
            return _passed(before, entry, pose_history, astray=1), Outcome(entry, None, None, {})
        if where == "moved":
            begins = SessionStart("pose", place.jump_ns)
        try:
            return self._track(before, entry, contents, begins, pose_history)
        except optipmb.EffortError as error:
            # What the frame cannot be tracked with may be a density of too many objects: they are given up when they
            # have not been updated for so long, and the frame alone is not too much.
            silent_ns = frame_id.stamp_ns - before.density.stamp_ns
            if begins is None and before.density.stamp_ns >= 0 and silent_ns > GIVE_UP_NS:
                with suppress(optipmb.EffortError):
                    begins = SessionStart("effort", place.jump_ns)
                    return self._track(before, entry, contents, begins, pose_history)
            return _passed(before, entry, sensor.pose_history, effort=1), Outcome(entry, None, None, {}, error)

    def on_new_clock(
        self, before: FilterState, entry: Entry, message: schemas.Detections | None = None
    ) -> FilterState | None:
        """Return the state with its stamps set back, where a frame begins a life because the clock stepped back.

        The objects are where they were: for as long as the frames that agreed on the step took, they go on. None where
        the frame begins no life, or its stamps or its sensor are too far from those before to say so.
        """
        sensor = before.sensor(entry.frame_id.sensor)
        cursor, last, history = sensor.cursor, before.last, sensor.pose_history
        same = last is not None and cursor.epoch == entry.frame_id.epoch and cursor.jumped > 0
        if not same or not begins_with(before, entry) or not -self._policy.gap_limit_ns <= entry.place.jump_ns < 0:
            return None
        stamp_ns = entry.frame_id.stamp_ns
        density = set_clock(before.density, max(0, stamp_ns - JUMP_FRAMES * (stamp_ns - cursor.jumped_ns)))
        if history.stamp_ns is not None:
            history = replace(history, stamp_ns=density.stamp_ns)
        if judge(history, message or entry.message, self._policy)[1] != "near":
            return None
        known = replace(sensor, pose_history=history)
        return replace(before, density=density, sensors=_sensors(before, entry.frame_id.sensor, known))

    def _others_stayed(self, before: FilterState, frame_id: FrameId) -> bool:
        """Whether another sensor of the session is where it was, as far as was heard lately."""
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
        entry: Entry,
        contents: Contents,
        begins: SessionStart | None,
        pose_history: PoseHistory,
    ) -> tuple[FilterState, Outcome]:
        frame_id = entry.frame_id
        if begins:
            starts, density = before.starts + 1, before.density
            if begins.reason not in {"first", "clock"}:
                density = optipmb.Density.empty(self.parameters.labels, density.next_id)
            before = before.begun_anew(density, self.name(frame_id, starts), starts)
        sensor = before.sensor(frame_id.sensor)
        frame = contents.frame
        if entry.points is not None:
            frame = replace(frame, cloud=convert.cloud_of(entry.points))
        result = self._tracker.step(before.density, frame)
        used = bool(result.diagnostics.cloud_used)
        same = sensor.tracked is not None and sensor.tracked[0] == frame_id.epoch
        highest = sensor.tracked[1] if sensor.tracked is not None and same else frame_id.seq - 1
        gap = max(0, frame_id.seq - highest - 1)
        tracks = tracks_of(
            result.tracks,
            result.paths,
            result.class_probability,
            stream=self.stream,
            frame_id=frame_id,
            session=before.session,
            revision=entry.revision,
            parameters=self.parameters,
            cloud_used=used,
            gap=gap,
            ignored=contents.ignored,
        )
        unknown = self._unknown(contents.message, sensor.reported) if contents.ignored else {}
        repaired = int(result.diagnostics.repaired)
        known = SensorState(
            cursor=sensor.cursor.after(frame_id, entry.place),
            tracked=(frame_id.epoch, max(highest, frame_id.seq)),
            reported=sensor.reported | unknown.keys() if unknown else sensor.reported,
            pose_history=pose_history,
        )
        after = FilterState(
            density=result.density,
            session=before.session,
            starts=before.starts,
            generation=entry.place.generation,
            last=frame_id,
            tracks=len(result.tracks),
            counts=_counted(before, entry, tracked=1, gap=gap, used=used, repaired=repaired),
            sensors=_sensors(before, frame_id.sensor, known),
        )
        return after, Outcome(entry, tracks, begins, unknown)

    def _unknown(self, message: schemas.Detections, reported: frozenset[str]) -> dict[str, int]:
        found = convert.unknown_labels(self.parameters, message)
        new = sorted(found.keys() - reported)[: max(0, MAX_LABELS - len(reported))]
        return {label: found[label] for label in found if label in new}


def _passed(
    before: FilterState,
    entry: Entry,
    pose_history: PoseHistory,
    *,
    astray: int = 0,
    effort: int = 0,
    unconfirmed: int = 0,
) -> FilterState:
    """Return the state after a frame that is refused."""
    counts = _counted(before, entry, astray=astray, effort=effort, unconfirmed=unconfirmed)
    frame_id, sensor = entry.frame_id, before.sensor(entry.frame_id.sensor)
    passed = replace(sensor, cursor=sensor.cursor.after(frame_id, entry.place), pose_history=pose_history)
    return replace(before, last=frame_id, counts=counts, sensors=_sensors(before, frame_id.sensor, passed))


def _sensors(before: FilterState, name: str, state: SensorState) -> dict[str, SensorState]:
    """Return the sensors after a frame of one; when there are too many, the one that was silent for longest goes."""
    sensors = {**before.sensors, name: state}
    if len(sensors) > MAX_SENSORS:
        others = [(one.cursor.generation, one.cursor.newest_ns, other) for other, one in before.sensors.items()]
        del sensors[min(one for one in others if one[2] != name)[2]]
    return sensors


def _counted(  # noqa: PLR0913 - all keywords, each a count
    state: FilterState,
    entry: Entry,
    *,
    astray: int = 0,
    effort: int = 0,
    unconfirmed: int = 0,
    tracked: int = 0,
    gap: int = 0,
    used: bool = False,
    repaired: int = 0,
) -> FrameCounts:
    """Return the counts with one more frame."""
    before, frame_id = state.counts, entry.frame_id
    # In a session of several sensors each has its epochs; how one follows another follows from the frames before.
    succeeds = bool(frame_id.sensor) and state.sensor(frame_id.sensor).cursor.epoch not in {None, frame_id.epoch}
    return FrameCounts(
        frames=before.frames + tracked,
        gaps=total(before.gaps, gap) if gap else before.gaps,
        new_epochs=before.new_epochs + (entry.place.opens in _OPENING or succeeds),
        clouds_used=before.clouds_used + used,
        clouds_missed=before.clouds_missed + entry.missed,
        astray=before.astray + astray,
        effort=before.effort + effort,
        unconfirmed=before.unconfirmed + unconfirmed,
        repaired=before.repaired + repaired,
    )


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
    )


def empty(
    transition: Transition, last: FrameId | None, next_id: int, starts: int, counts: FrameCounts | None = None
) -> FilterState:
    """Return the moment before the first frame of a stream, or of a profile."""
    density = optipmb.Density.empty(transition.parameters.labels, next_id)
    return FilterState(density, transition.name(last, starts), starts=starts, counts=counts or FrameCounts())


def begins_with(before: FilterState, entry: Entry) -> bool:
    """Whether the place of a frame makes it begin with an empty density."""
    return before.last is not None and entry.place.generation != before.generation


def _begins(before: FilterState, entry: Entry) -> SessionStart | None:
    if before.last is None:
        return SessionStart("first", entry.place.jump_ns)
    if entry.place.generation != before.generation:
        if entry.frame_id.sensor:
            return SessionStart("jump", entry.frame_id.stamp_ns - before.last.stamp_ns)
        other = entry.frame_id.epoch != before.last.epoch
        return SessionStart("publisher" if other else "jump", entry.place.jump_ns)
    return None
