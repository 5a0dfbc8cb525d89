"""Settings and outputs of sessions as plain values; times in nanoseconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
import optipmb_schemas as schemas
from pydantic import AfterValidator, Field

import optipmb
from optipmb.parameters import ALIKE
from optipmb.zones import COUNTS, Event, Zone

SECOND: Final = 1_000_000_000

COLUMNS: Final = tuple(optipmb.Tracks.described)
"""Columns of the tracks in the order of the message."""

# What checkpoints hold, as pydantic reads it.
Whole = Annotated[int, Field(strict=True, ge=0, lt=2**63)]
Binary = Annotated[bytes, Field(strict=True)]
Epoch = Annotated[bytes, Field(strict=True, min_length=16, max_length=16)]


def _check_sensor(name: str) -> str:
    if name:
        schemas.Keys().tracks(name)
    return name


SensorName = Annotated[str, Field(strict=True), AfterValidator(_check_sensor)]
"""Stream of a sensor; empty for the only one of a stream's own session."""


Reached = tuple[int, int, str]
"""Incarnations so far, stamp of the last frame, and session id: in this order states of a stream follow each other."""


ZoneCounts = Mapping[str, Mapping[str, Mapping[str, int]]]
"""Counts by zone, name of `COUNTS` and class."""


class JumpLimits(NamedTuple):
    """Steps of the stamps, in the order of a publisher, beyond which they jumped.

    Attributes:
        back_ns: largest step back: within it a late frame is inserted.
        ahead_ns: largest step ahead.
    """

    back_ns: int
    ahead_ns: int


MAX_CLOUD_WAIT_NS: Final = 60 * SECOND
"""The longest wait for a cloud that can be asked for."""

MAX_SENSORS: Final = 64
"""Sensors of one session."""

MAX_ERROR: Final = 400
"""Characters kept of an error."""

MAX_LABELS: Final = 256
"""Unknown class names remembered as reported."""


@dataclass(frozen=True, slots=True)
class Policy:
    """The settings that a session follows; lengths in metres, speeds in metres per second.

    Attributes:
        gap_limit_ns: a larger step of the stamps restarts the session.
        cloud_wait_ns: longest wait of a frame for its cloud.
        cloud_memory_ns: how lately a cloud must have come for a frame that does not say whether it has one.
        clouds: number of clouds kept.
        cloud_bytes: most bytes of these.
        held_bytes: most bytes of frames held for clouds or for missed frames.
        rewind_ns: sensor time within which a late frame is put in its place; 0: late frames are refused.
        rewind_frames: most frames kept for it.
        rewind_bytes: most bytes of messages kept for it.
        checkpoint_bytes: most bytes of messages that a checkpoint takes along; with large clouds a restored session
            goes back less far.
        late_clouds: whether a cloud that comes after its frame was tracked is put in too, inside the window.
        recovery_wait_ns: longest time after a restore that frames behind a gap are held for those missing.
        max_speed: fastest that a sensor moves; 0: any pose is taken.
        pose_margin: how far a pose may lie from where that speed allows.
        astray_frames: frames in a row that agree on another place until the session restarts there.
        jumps: reaction to poses that jump within reach: `report` or `off`.
        zones: those whose events the session finds.
        rejoin: how tracks are joined over gaps; None: they are not.
        sensors: how the frames of the sensors of a fused session are used.
        needs_view: whether a sensor without field of view is reported.
        has_place: whether the setting `sites` has a place of its world frame.
        at_once: frames that are ready which one call takes through the tracker; the next calls take the others. More
            are taken only while more than `held_bytes` are held.
    """

    gap_limit_ns: int = 5 * SECOND
    cloud_wait_ns: int = SECOND // 10
    cloud_memory_ns: int = 2 * SECOND
    clouds: int = 16
    cloud_bytes: int = 32 * 2**20
    held_bytes: int = 32 * 2**20
    rewind_ns: int = SECOND
    rewind_frames: int = 64
    rewind_bytes: int = 32 * 2**20
    checkpoint_bytes: int = 2**20
    late_clouds: bool = False
    recovery_wait_ns: int = 2 * SECOND
    max_speed: float = 100.0
    pose_margin: float = 10.0
    astray_frames: int = 5
    jumps: Literal["off", "report"] = "report"
    at_once: int = 2**62
    zones: tuple[Zone, ...] = ()
    rejoin: optipmb.Rejoin | None = None
    sensors: optipmb.Sensors = ALIKE
    needs_view: bool = False
    has_place: bool = False

    @property
    def jump_limits(self) -> JumpLimits:
        """The steps of a publisher's stamps beyond which they jumped."""
        return JumpLimits(min(self.rewind_ns, self.gap_limit_ns), self.gap_limit_ns)


@dataclass(frozen=True, slots=True)
class Incarnation:
    """Numbers that the next session of a stream continues, so that neither its id nor its track ids come again.

    Attributes:
        starts: incarnations of the density so far.
        next_id: the next track id.
        run: see `Session.run`; of the next session, higher than any that may have published before.
        events: number of the last event of each zone and kind.
    """

    starts: int = 0
    next_id: int = 1
    run: int = 0
    events: Mapping[str, int] = field(default_factory=dict)

    def after(self, other: Incarnation) -> Incarnation:
        """Return the numbers that follow both."""
        zones = self.events.keys() | other.events.keys()
        return Incarnation(
            max(self.starts, other.starts),
            max(self.next_id, other.next_id),
            max(self.run, other.run),
            {zone: max(self.events.get(zone, 0), other.events.get(zone, 0)) for zone in sorted(zones)},
        )


@dataclass(slots=True)
class TrackedFrame:
    """Tracks of a frame.

    The message is built when somebody reads it. The bytes to publish are put together without it: the columns of the
    tracks lie one behind the other in one array, in the order in which the message has them.

    Attributes:
        estimates: tracks of the tracker, with numbers that a message may hold.
        header: the fields of the message before the columns, those without a value left out.
        others: the fields behind the columns: classes, objects and predicted paths, where the session has them.
        ticket: value that the caller gave with the detections.
        step_ns: time that conversion and tracking took.
        run: see `Session.run`.
        events: of the zones.
        counts: of all zones after the frame, by zone, name of `COUNTS` and class; None: not to be published.
        final: up to where the window does not change any more.
    """

    estimates: optipmb.Tracks
    header: dict[str, Any]
    others: dict[str, Any]
    ticket: Any = None
    step_ns: int = 0
    run: int = 0
    events: tuple[Event, ...] = ()
    counts: ZoneCounts | None = None
    final: Reached = (0, 0, "")

    @property
    def tracks(self) -> schemas.Tracks:
        """The message, without its delivery part."""
        columns: dict[str, Any] = dict(self.estimates.columns())
        columns["confirmed"] = columns["confirmed"].astype(np.int64)
        for column in columns.values():
            column.flags.writeable = False
        return schemas.Tracks.trusted(self.header | columns | self.others)

    def encoded(self, delivery: dict[str, Any]) -> bytes:
        """Return the bytes of the message with a delivery part of these values, all that it has, in its order."""
        words, others = self.estimates.words, self.others | {"delivery": delivery}
        return schemas.encode_columns(schemas.Tracks, self.header, COLUMNS, words, others)

    def encoded_events(self, delivery: dict[str, Any], durable: Reached | None) -> bytes | None:
        """Return the bytes of the message with the events and counts of zones, None where there are none.

        Args:
            delivery: the values of its delivery part.
            durable: how far a process that took over would not go back; None: nothing is final.
        """
        if not self.events and self.counts is None:
            return None
        if durable is not None:
            _, final_ns, session = min(self.final, durable)
            delivery = delivery | {"final_session": session, "final_ns": final_ns}
        message = events_of(self.header, self.events, self.counts)
        return schemas.encode(message, delivery=schemas.Delivery.trusted(delivery))


def events_of(header: dict[str, Any], events: Sequence[Event], counts: ZoneCounts | None) -> schemas.Events:
    """Return the message of a frame with the header of its tracks."""
    named = (label for zone in (counts or {}).values() for by_class in zone.values() for label in by_class)
    # Of a profile that was in force before there may be classes that this one lacks.
    labels = tuple(dict.fromkeys((*header["labels"], *(one.label for one in events), *sorted(named))))
    told: list[schemas.ZoneEvent] = []
    for one in events:
        values: dict[str, Any] = {name: None if value == "" else value for name, value in one._asdict().items()}
        dwell_s = one.dwell_s if one.kind in {"left", "stayed"} else None
        told.append(schemas.ZoneEvent.trusted(values | {"label": labels.index(one.label), "dwell_s": dwell_s}))
    zones = tuple(
        schemas.ZoneCount.trusted(
            {"zone": name} | {one: tuple(by.get(one, {}).get(label, 0) for label in labels) for one in COUNTS}
        )
        for name, by in (counts or {}).items()
    )
    fields = header | {"labels": labels, "events": tuple(told), "zones": None if counts is None else zones}
    return schemas.Events(**fields)


Reason = Literal["first", "jump", "clock", "publisher", "pose", "world", "effort", "reset", "parameters", "quarantine"]
"""Why the density started again; `clock`: after a step back, with its objects."""


@dataclass(frozen=True, slots=True)
class Begun:
    """Start of a session id: at the first frame, at a jump, by a reset.

    Attributes:
        session: the id.
        reason: why.
        jump_ns: how far the stamps jumped.
    """

    session: str
    reason: Reason
    jump_ns: int = 0


@dataclass(frozen=True, slots=True)
class Quarantined:
    """A step raised: the session takes no more frames until it is reset or another publisher begins.

    Attributes:
        error: type and text of the exception.
        dump: what `optipmb track --dump` replays to the same error.
    """

    error: str
    dump: bytes


Output = TrackedFrame | schemas.Problem | Begun | Quarantined


class RefusedError(ValueError):
    """A command was refused.

    Attributes:
        path: the field of the request.
        expected: what would have been accepted.
        received: the value asked for.
    """

    def __init__(self, path: str, expected: str, received: str) -> None:
        super().__init__(f"{path}: expected {expected}, received {received}")
        self.path = path
        self.expected = expected
        self.received = received
