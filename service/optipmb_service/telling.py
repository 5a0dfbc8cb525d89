"""What a session tells of itself: its counters, and the message that answers a query."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Literal

import optipmb_schemas as schemas

from optipmb_service.records import Counters

if TYPE_CHECKING:
    from optipmb_service.moments import Counts, Moment
    from optipmb_service.records import Deliveries

    Condition = Literal["new", "running", "recovering", "quarantined", "closed"]


def counters_of(deliveries: Deliveries, counts: Counts) -> Counters:
    """Return what happened to the messages: what depends on their delivery, and what follows from the frames alone."""
    return Counters(
        frames=counts.frames,
        duplicates=deliveries.duplicates,
        late=deliveries.late,
        inserted=deliveries.inserted,
        corrected=deliveries.corrected,
        refused=deliveries.refused + counts.astray,
        gaps=counts.gaps,
        new_epochs=counts.new_epochs,
        clouds_used=counts.clouds_used,
        clouds_missed=counts.clouds_missed,
        repaired=counts.repaired,
    )


def state_of(
    stream: str, profile: str, head: Moment, counters: Counters, *, condition: Condition, shed: int, queue: int
) -> schemas.SessionState:
    """Return the state as the message that answers a query.

    Args:
        stream: `site/node/sensor`.
        profile: name of the parameters.
        head: the present moment.
        counters: what happened to the messages.
        condition: what the session does at present.
        shed: frames dropped before they came to the session.
        queue: frames that wait.
    """
    density, last = head.density, head.last
    return schemas.SessionState(
        stream=stream,
        session=head.session,
        state=condition,
        profile=profile,
        epoch=last.epoch if last else None,
        seq=last.seq if last else None,
        stamp_ns=last.stamp_ns if last else None,
        shed=shed,
        **{field.name: getattr(counters, field.name) for field in fields(Counters)},
        tracks=head.tracks,
        bernoullis=len(density.bernoulli),
        poissons=len(density.poisson),
        next_id=density.next_id,
        queue=queue,
    )
