"""One frame through the tracker: from one moment of a session to the next, and the tracks in between.

A pure function of moment, frame and parameters, so that frames can be gone through once more whenever one is put
between them. Whatever it raises, nothing has changed.

A session id names one life of the density. It is derived from the stream, the frame at which that life began and the
parameters, so that a repeated run gives it again, and a service that was restarted without its checkpoints and went on
with another frame does not. When a late frame turns out to be the first of a life, the life gets the id that it would
have had in order; the tracks that were published under the other are corrected like all others behind that frame.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import optipmb
from optipmb_service import convert
from optipmb_service.moments import Counts, Entry, Moment, Whereabouts
from optipmb_service.timing import Mark, Verdict
from optipmb_service.whereabouts import judge, position_of

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.records import Policy, Steps

MAX_LABELS: Final = 256
"""Unknown class names remembered as reported."""

_OPENING: Final = frozenset({Verdict.NEW_EPOCH, Verdict.RESTART})


@dataclass(frozen=True, slots=True)
class Begins:
    """Why a life of the density begins with a frame.

    Attributes:
        reason: see `records.Begun`.
        jump_ns: how far the stamps jumped.
    """

    reason: Literal["first", "jump", "publisher", "pose"]
    jump_ns: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a frame.

    Attributes:
        entry: the frame.
        tracks: its tracks, without their delivery part; None: it was refused, as astray.
        begins: whether a life began with it.
        unknown: the classes that the profile lacks, with the number of objects of each, when not reported before.
    """

    entry: Entry
    tracks: schemas.Tracks | None
    begins: Begins | None
    unknown: dict[str, int]


class Stepper:
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
        values = json.dumps(parameters.model_dump(mode="json"))
        self._digest = hashlib.blake2b(values.encode(), digest_size=16).digest()

    def name(self, mark: Mark | None, starts: int) -> str:
        """Return the id of a life that begins with or after a frame."""
        digest = hashlib.blake2b(self._digest, digest_size=16, person=b"optipmb-session")
        where = (mark.epoch.hex(), mark.seq, mark.stamp_ns) if mark else ()
        digest.update(json.dumps([self.stream, starts, *where]).encode())
        return digest.hexdigest()

    def step(self, before: Moment, entry: Entry) -> tuple[Moment, Outcome]:
        """Go on by one frame.

        Raises:
            Exception: whatever the tracker raises.
        """
        mark, place = entry.mark, entry.place
        begins = _begins(before, entry)
        known = Whereabouts() if begins else before.whereabouts
        whereabouts, where = judge(known, mark.stamp_ns, position_of(entry.message), self._policy)
        if where == "astray":
            counts = _counted(before.counts, entry, astray=1)
            course = before.course.after(mark, place)
            passed = replace(before, course=course, last=mark, counts=counts, whereabouts=whereabouts)
            return passed, Outcome(entry, None, None, {})
        if where == "moved":
            begins = Begins("pose", place.jump_ns)
        return self._track(before, entry, begins, whereabouts)

    def _track(
        self, before: Moment, entry: Entry, begins: Begins | None, whereabouts: Whereabouts
    ) -> tuple[Moment, Outcome]:
        mark, density, session, starts = entry.mark, before.density, before.session, before.starts
        reported = before.reported
        if begins:
            starts += 1
            session = self.name(mark, starts)
            reported = frozenset()
            if begins.reason != "first":
                density = optipmb.Density.empty(density.next_id)
        frame = entry.frame
        if entry.points is not None:
            frame = replace(frame, cloud=convert.cloud_of(entry.points))
        result = self._tracker.step(density, frame)
        used = bool(result.diagnostics.cloud_used)
        same = before.tracked is not None and before.tracked[0] == mark.epoch
        highest = before.tracked[1] if before.tracked is not None and same else mark.seq - 1
        gap = max(0, mark.seq - highest - 1)
        tracks = convert.tracks_of(
            result.tracks,
            stream=self.stream,
            mark=mark,
            session=session,
            revision=entry.revision,
            parameters=self.parameters,
            cloud_used=used,
            gap=gap,
            ignored=entry.ignored,
        )
        unknown = self._unknown(entry, reported) if entry.ignored else {}
        repaired = int(result.diagnostics.repaired)
        after = Moment(
            density=result.density,
            session=session,
            starts=starts,
            generation=entry.place.generation,
            course=before.course.after(mark, entry.place),
            last=mark,
            tracked=(mark.epoch, max(highest, mark.seq)),
            tracks=len(tracks.id),
            counts=_counted(before.counts, entry, tracked=1, gap=gap, used=used, repaired=repaired),
            reported=reported | unknown.keys() if unknown else reported,
            whereabouts=whereabouts,
        )
        return after, Outcome(entry, tracks, begins, unknown)

    def _unknown(self, entry: Entry, reported: frozenset[str]) -> dict[str, int]:
        found = convert.unknown_labels(self.parameters, entry.message)
        new = sorted(found.keys() - reported)[: max(0, MAX_LABELS - len(reported))]
        return {label: found[label] for label in found if label in new}


def _counted(
    before: Counts,
    entry: Entry,
    *,
    astray: int = 0,
    tracked: int = 0,
    gap: int = 0,
    used: bool = False,
    repaired: int = 0,
) -> Counts:
    """Return the counts with one more frame."""
    return Counts(
        frames=before.frames + tracked,
        gaps=before.gaps + gap,
        new_epochs=before.new_epochs + (entry.place.opens in _OPENING),
        clouds_used=before.clouds_used + used,
        clouds_missed=before.clouds_missed + entry.missed,
        astray=before.astray + astray,
        repaired=before.repaired + repaired,
    )


def empty(stepper: Stepper, last: Mark | None, next_id: int, starts: int, counts: Counts | None = None) -> Moment:
    """Return the moment before the first frame of a stream, or of a profile."""
    return Moment(optipmb.Density.empty(next_id), stepper.name(last, starts), starts=starts, counts=counts or Counts())


def begins_with(before: Moment, entry: Entry) -> bool:
    """Whether the place of a frame makes it begin with an empty density."""
    return before.last is not None and entry.place.generation != before.generation


def _begins(before: Moment, entry: Entry) -> Begins | None:
    if before.last is None:
        return Begins("first", entry.place.jump_ns)
    if entry.place.generation != before.generation:
        other = entry.mark.epoch != before.last.epoch
        return Begins("publisher" if other else "jump", entry.place.jump_ns)
    return None
