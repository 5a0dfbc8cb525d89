"""Outputs of sessions: tracks of frames, starts, quarantine, problems; and the refusal of a command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import optipmb_schemas as schemas

import optipmb
from optipmb.world.zones import COUNTS, Event

if TYPE_CHECKING:
    from optipmb_service.session.identity import Reached

COLUMNS: Final = tuple(optipmb.Tracks.described)
"""Columns of the tracks in the order of the message."""

ZoneCounts = Mapping[str, Mapping[str, Mapping[str, int]]]
"""Counts by zone, name of `COUNTS` and class."""


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
        known: attributes of the objects of these.
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
    known: tuple[schemas.Attribute, ...] = ()
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
        message = events_of(self.header, self.events, self.counts, self.known)
        return schemas.encode(message, delivery=schemas.Delivery.trusted(delivery))


def events_of(
    header: dict[str, Any],
    events: Sequence[Event],
    counts: ZoneCounts | None,
    known: tuple[schemas.Attribute, ...] = (),
) -> schemas.Events:
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
    fields["attributes"] = known or None
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


class CommandRefusedError(ValueError):
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
