"""The state of a session between two frames, and the frames themselves, as values that never change.

A `FilterState` holds all that a frame's tracks follow from, and nothing that depends on how messages were delivered. So
two sessions that took the same frames have equal states, with any repeats, delays or crashes.
"""

from __future__ import annotations

from dataclasses import field, replace
from typing import TYPE_CHECKING, Annotated, Final, TypeAlias

import optipmb_schemas as schemas
from pydantic import Field

from optipmb.model.rows import record
from optipmb_service.session.counts import Count, FrameCounts
from optipmb_service.session.identity import Epoch, Incarnation, Reached, Whole
from optipmb_service.session.timeline import Cursor, FrameId, Order, Placement, Verdict

if TYPE_CHECKING:
    from collections.abc import Mapping

    import optipmb
    from optipmb.world.zones import ZoneState
    from optipmb_service.session.worlds import Worlds

MAX_LABELS: Final = 256
"""Unknown class names remembered as reported."""

ClassName = Annotated[str, Field(strict=True, max_length=64)]
_Metres = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Position = tuple[_Metres, _Metres, _Metres]


@record
class PoseHistory:
    """Last pose of a sensor, and the poses refused since.

    Attributes:
        stamp_ns: when; None before the first frame with a pose.
        position: x, y, z in the world, m.
        astray: frames in a row that were refused because they were too far from there.
        astray_ns: when the newest of these was.
        astray_position: and where.
    """

    stamp_ns: Whole | None = None
    position: Position = (0.0, 0.0, 0.0)
    astray: Count = 0
    astray_ns: Whole = 0
    astray_position: Position = (0.0, 0.0, 0.0)


@record
class SensorState:
    """State of one sensor after its frames so far.

    Attributes:
        cursor: its course; see `timeline`.
        tracked: epoch and highest sequence number of its frames tracked, for counting gaps.
        reported: its unknown classes that were reported in this incarnation.
        pose_history: where it was.
    """

    cursor: Cursor = field(default_factory=Cursor)
    tracked: tuple[Epoch, Whole] | None = None
    reported: Annotated[frozenset[ClassName], Field(max_length=MAX_LABELS)] = frozenset()
    pose_history: PoseHistory = field(default_factory=PoseHistory)


_UNKNOWN: Final = SensorState()


@record
class FilterState:
    """A session between two frames.

    Attributes:
        density: after the last frame.
        session: id of the present incarnation of the density.
        starts: incarnations so far.
        generation: see `timeline`; of the last frame tracked.
        last: the last frame processed, tracked or not.
        tracks: number of confirmed tracks at the last frame tracked.
        counts: of the frames.
        sensors: each sensor by its stream; the only one of a stream's own session by an empty name.
        zones: state of the zones; None: it has none.
        worlds: its world frames; None: no relocation was announced.
    """

    density: optipmb.Density
    session: str
    starts: int = 0
    generation: int = 0
    last: FrameId | None = None
    tracks: int = 0
    counts: FrameCounts = field(default_factory=FrameCounts)
    sensors: Mapping[str, SensorState] = field(default_factory=dict)
    zones: ZoneState | None = None
    worlds: Worlds | None = None

    def sensor(self, name: str) -> SensorState:
        """Return the state of a sensor, the initial one before its first frame."""
        return self.sensors.get(name, _UNKNOWN)

    @property
    def cursors(self) -> dict[str, Cursor]:
        """The courses of the sensors."""
        return {name: one.cursor for name, one in self.sensors.items()}

    @property
    def reached(self) -> Reached:
        """How far the stream has come with it."""
        return self.starts, self.last.stamp_ns if self.last else 0, self.session

    def incarnation(self, run: int) -> Incarnation:
        """Return the numbers that a later session continues after a run."""
        events = {} if self.zones is None else self.zones.numbers
        return Incarnation(self.starts, self.density.next_id, run, events)

    def begun_anew(self, density: optipmb.Density, session: str) -> FilterState:
        """Return the state in which the next incarnation of the density begins: no classes were reported yet."""
        sensors = {
            name: replace(one, reported=frozenset(), pose_history=PoseHistory()) for name, one in self.sensors.items()
        }
        return replace(self, density=density, session=session, starts=self.starts + 1, sensors=sensors, tracks=0)


Inputs: TypeAlias = "tuple[schemas.Detections, optipmb.Frame, int]"
"""Detections of a frame, the same as the tracker reads them without the cloud, and the number of objects left out
because the profile lacks their class."""

UNPLACED: Final = Placement(0, 0, None, Verdict.NEXT, 0, 0)
"""Place of a frame that was read from a checkpoint, until the timeline gives it one."""


@record
class ProcessedFrame:
    """Frame that is or was processed, as the window and checkpoints keep it.

    Its detections are bytes: few of the frames that are kept are processed again, and those are decoded once more.
    Decoded, they take twice the memory, in some forty pieces, and where each frame fills the memory of one long past
    instead of the one before, a frame of 40 objects takes 3 % longer.

    Attributes:
        frame_id: its identity.
        detections: its detections as `schemas.encode` gives them.
        points: its cloud.
        missed: whether it waited for a cloud in vain.
        revision: of the tracks that were published last for it.
        packed: its cloud as bytes, once a checkpoint has encoded it: it is in one checkpoint after the other.
        place: where it belongs; checkpoints leave it out.
    """

    frame_id: FrameId
    detections: bytes
    points: schemas.Points | None
    missed: bool
    revision: int
    packed: list[bytes] = field(compare=False)
    place: Placement

    @property
    def message(self) -> schemas.Detections:
        """Its detections, decoded."""
        return schemas.decode(self.detections, schemas.Detections, limits=schemas.STORED)

    @property
    def order(self) -> Order:
        return self.place.order(self.frame_id)

    @property
    def weight(self) -> int:
        """Bytes that its inputs take, nearly."""
        return size_of(self.detections, self.points)


def size_of(detections: bytes, points: schemas.Points | None = None) -> int:
    """Return the bytes that the inputs of a frame take, nearly."""
    return _OBJECTS + len(detections) + (points.xyz.nbytes if points is not None else 0)


_OBJECTS: Final = 256
"""Bytes of what holds the inputs of a frame together."""
