"""World frames of a session: the motions between them that its publishers have announced, as pure functions.

Worlds are numbered. The density is in the newest one. A frame of the next world moves it there with all that has a
place: poses of the sensors, kept positions of zones. A frame of an older world, of a sensor that has not switched yet,
is moved to the newest one, as far back as the motions are kept.

A publisher counts its worlds from 1 in each epoch, so a restarted one begins again. The first message of an epoch, and
of a sensor, is of the present world, unless it has another motion than the one that led there.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping  # noqa: TC003 - checkpoints read the records by their annotations
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from pydantic import Field

import optipmb
from optipmb.rows import record
from optipmb.zones import relocated as relocated_zones
from optipmb_service.stream.values import MAX_SENSORS, SensorName, Whole

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.stream.state import FilterState, PoseHistory
    from optipmb_service.stream.timeline import FrameId

KEPT: Final = 8
"""Motions kept: sensors of a fused session may be so many worlds apart."""

_Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_Motion = tuple[_Number, _Number, _Number, _Number]


class SensorWorld(NamedTuple):
    """World of a sensor's last frame, and the one that its publisher counts from."""

    number: Whole
    zero: Annotated[int, Field(strict=True, gt=-(2**63), lt=2**63)]


@record
class Worlds:
    """Worlds of a session in which a relocation was announced.

    Attributes:
        number: of the density.
        motions: into the newest worlds, the last one into that of the density; `optipmb.Relocation`.
        sensors: of each sensor.
    """

    number: Whole
    motions: Annotated[tuple[_Motion, ...], Field(max_length=KEPT)]
    sensors: Annotated[Mapping[SensorName, SensorWorld], Field(max_length=MAX_SENSORS)]

    def motion_into(self, world: int) -> optipmb.Relocation | None:
        """Return the motion from the world before into one, None if it is not kept."""
        behind = self.number - world
        return optipmb.Relocation(*self.motions[-1 - behind]) if 0 <= behind < len(self.motions) else None


class Relocated(NamedTuple):
    """A session before a frame, and the frame, in the newest world.

    Attributes:
        state: the session.
        frame: the frame; None where none was given.
        ahead: motions that brought the frame there.
        announced: whether the world moves with the frame.
        restarts: whether the motion from the world before is unknown.
        fault: of the relocation of the frame.
        lost: whether the frame cannot be brought to the newest world.
    """

    state: FilterState
    frame: Any = None
    ahead: tuple[optipmb.Relocation, ...] = ()
    announced: bool = False
    restarts: bool = False
    fault: optipmb.FrameError | None = None
    lost: bool = False


def in_one_world(message: schemas.Detections, points: schemas.Points) -> bool:
    """Return whether a cloud is of the world of its detections, as far as both say."""
    one, other = message.relocation, points.relocation
    return one is None or other is None or message.epoch != points.epoch or one.world == other.world


def relocated(
    before: FilterState, frame_id: FrameId, relocation: schemas.Relocation | None, frame: optipmb.Frame | None = None
) -> Relocated:
    """Return a session and a frame in the world of the frame, or in the newest one, where that is newer."""
    if relocation is None and before.worlds is None:
        return Relocated(before, frame)
    worlds = before.worlds or Worlds(0, (), dict.fromkeys(before.sensors, SensorWorld(0, 0)))
    name = frame_id.sensor
    continues = before.sensor(name).cursor.epoch == frame_id.epoch
    number, zero = worlds.sensors.get(name, SensorWorld(worlds.number, 0))
    motion, here, known_way = None, number, True
    if relocation is None:
        zero = zero if continues else number
    else:
        motion = optipmb.Relocation.of(optipmb.Pose(relocation.translation, relocation.quaternion))
        here = zero + relocation.world
        if before.last is None:
            worlds = Worlds(here, (motion,), {})
        elif not continues and (motion == worlds.motion_into(number) or relocation.world == 1):
            here = number + (motion != worlds.motion_into(number))
            zero = here - relocation.world
        known_way = number <= here <= number + 1 or motion == worlds.motion_into(here) or before.last is None
    sensor = SensorWorld(here, zero)
    if known_way and here <= worlds.number:
        return _behind(_in_world(before, name, worlds, sensor), here, motion, frame)
    if known_way and here == worlds.number + 1 and motion is not None:
        worlds = replace(worlds, number=here, motions=(*worlds.motions, motion)[-KEPT:])
        with suppress(optipmb.DensityError):
            return Relocated(_moved(_in_world(before, name, worlds, sensor), motion), frame, announced=True)
    worlds = replace(worlds, number=here, motions=() if motion is None else (motion,))
    return Relocated(_in_world(before, name, worlds, sensor), frame, restarts=True)


def _behind(state: FilterState, here: int, motion: optipmb.Relocation | None, frame: optipmb.Frame | None) -> Relocated:
    """Return a frame of a known world in the newest one, and the fault of another motion into its world."""
    worlds, fault = state.worlds, None
    assert worlds is not None  # noqa: S101 - said for the type checker
    if motion is not None and motion != (first := worlds.motion_into(here) or motion):
        fault = optipmb.FrameError("relocation", f"that of world {here} before, {tuple(first)}", str(tuple(motion)))
    steps = worlds.number - here
    if steps > len(worlds.motions):
        expected = f"a world of the last {KEPT} before {worlds.number}"
        return Relocated(state, fault=optipmb.FrameError("relocation.world", expected, str(here)), lost=True)
    ahead = tuple(optipmb.Relocation(*one) for one in worlds.motions[len(worlds.motions) - steps :])
    try:
        moved = frame if frame is None else functools.reduce(lambda seen, one: one.frame(seen), ahead, frame)
    except optipmb.FrameError as error:
        return Relocated(state, fault=error, lost=True)
    return Relocated(state, moved, ahead, fault=fault)


def _in_world(before: FilterState, name: str, worlds: Worlds, sensor: SensorWorld) -> FilterState:
    known = {other: one for other, one in worlds.sensors.items() if other in before.sensors}
    return replace(before, worlds=replace(worlds, sensors=known | {name: sensor}))


def _moved(state: FilterState, motion: optipmb.Relocation) -> FilterState:
    """Return a state whose density and places have moved."""

    def history(one: PoseHistory) -> PoseHistory:
        return replace(one, position=motion.place(one.position), astray_position=motion.place(one.astray_position))

    return replace(
        state,
        density=motion.density(state.density),
        sensors={name: replace(one, pose_history=history(one.pose_history)) for name, one in state.sensors.items()},
        zones=None if state.zones is None else relocated_zones(state.zones, motion),
    )
