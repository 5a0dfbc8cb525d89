"""Names and numbers by which streams, publishers and incarnations are known, as checkpoints hold them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import optipmb_schemas as schemas
from pydantic import AfterValidator, Field

if TYPE_CHECKING:
    from collections.abc import Mapping

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
