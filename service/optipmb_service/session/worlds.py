"""World frames of a session: the motions between them that its publishers have announced, as pure functions.

Worlds are numbered, and the density is in the newest one. A frame of the next world moves the density there, with poses
of sensors and kept positions of zones. A frame of an older world, of a sensor that has not switched yet, is moved to
the newest one. A publisher counts from 1 in each epoch: the first message of an epoch or sensor is of the present
world, unless it has another motion than the one that led there.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - checkpoints read the records by their annotations
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

import optipmb
from optipmb.model.rows import record
from optipmb.world.zones import relocated as relocated_zones
from optipmb_service.session.identity import SensorName, Whole  # noqa: TC001 - pydantic reads the annotation
from optipmb_service.session.policy import MAX_SENSORS

if TYPE_CHECKING:
    import optipmb_schemas as schemas

    from optipmb_service.session.state import FilterState, SensorState
    from optipmb_service.session.timeline import FrameId

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
        motions: into the newest worlds, the last one into the density's; `optipmb.Relocation`.
        sensors: of each sensor.
    """

    number: Whole
    motions: Annotated[tuple[_Motion, ...], Field(max_length=KEPT)]
    sensors: Annotated[Mapping[SensorName, SensorWorld], Field(max_length=MAX_SENSORS + 1)]

    def since(self, world: int) -> tuple[optipmb.Relocation, ...]:
        """Return the motions from a world to the newest, as far as they are kept."""
        return tuple(
            optipmb.Relocation(*one) for one in self.motions[max(0, len(self.motions) - self.number + world) :]
        )


class Relocated(NamedTuple):
    """A session before a frame, in the newest world.

    Attributes:
        state: the session.
        ahead: motions that bring the frame to that world; None: they are not kept.
        change: `moves`, where the world moves with the frame; `restarts`, where it does so by an unknown motion.
        fault: of the relocation of the frame.
    """

    state: FilterState
    ahead: tuple[optipmb.Relocation, ...] | None = ()
    change: Literal["moves", "restarts", ""] = ""
    fault: optipmb.FrameError | None = None


def in_one_world(message: schemas.Detections, points: schemas.Points) -> bool:
    """Return whether a cloud is of the world of its detections, as far as both say."""
    one, other = message.relocation, points.relocation
    return one is None or other is None or message.epoch != points.epoch or one.world == other.world


def relocated(before: FilterState, frame_id: FrameId, relocation: schemas.Relocation | None) -> Relocated:
    """Return a session in the world of a frame, or in the newest one, where that is newer."""
    if relocation is None and before.worlds is None:
        return Relocated(before)
    worlds = before.worlds or Worlds(0, (), dict.fromkeys(before.sensors, SensorWorld(0, 0)))
    last = worlds.sensors.get(frame_id.sensor, SensorWorld(worlds.number, 0))
    same_publisher = before.sensor(frame_id.sensor).cursor.epoch == frame_id.epoch
    if relocation is None:
        motion = None
        now = last if same_publisher else SensorWorld(last.number, last.number)
        follows = True
    elif before.last is None:
        motion = _motion(relocation.translation.tobytes(), relocation.quaternion.tobytes())
        now = SensorWorld(last.zero + relocation.world, last.zero)
        worlds = Worlds(now.number, (motion,), {})
        follows = True
    else:
        motion = _motion(relocation.translation.tobytes(), relocation.quaternion.tobytes())
        now = _announced(worlds, last, relocation.world, motion, same_publisher=same_publisher)
        follows = now.number in {last.number, last.number + 1} or _leads_to(worlds, now.number, motion)
    if worlds.sensors.get(frame_id.sensor) != now:
        known = {name: one for name, one in worlds.sensors.items() if name in before.sensors}
        worlds = replace(worlds, sensors=known | {frame_id.sensor: now})
    if follows and now.number <= worlds.number:
        state = before if worlds is before.worlds else replace(before, worlds=worlds)
        return _behind(state, worlds, now.number, motion)
    if follows and now.number == worlds.number + 1 and motion is not None:
        moved = replace(worlds, number=now.number, motions=(*worlds.motions, motion)[-KEPT:])
        with suppress(optipmb.DensityError):
            return Relocated(_moved(before, moved, motion), change="moves")
    return _restarted(before, worlds, frame_id.sensor, SensorWorld(relocation.world, 0) if relocation else now, motion)


def _announced(
    worlds: Worlds, last: SensorWorld, world: int, motion: optipmb.Relocation, *, same_publisher: bool
) -> SensorWorld:
    """Return the world of a sensor whose publisher counts it as `world`, and reached it by a motion."""
    if not same_publisher:  # it counts from 1 again
        if _leads_to(worlds, last.number, motion):
            return SensorWorld(last.number, last.number - world)
        if world == 1:
            return SensorWorld(last.number + 1, last.number)
    return SensorWorld(last.zero + world, last.zero)


def _leads_to(worlds: Worlds, number: int, motion: optipmb.Relocation) -> bool:
    return worlds.since(number - 1)[:1] == (motion,)


def _restarted(
    state: FilterState, worlds: Worlds, sensor: str, now: SensorWorld, motion: optipmb.Relocation | None
) -> Relocated:
    """Return a session that begins in a world of which no motion from the world before is known."""
    motions = () if motion is None else (motion,)
    begun = Worlds(now.number, motions, {**worlds.sensors, sensor: now})
    return Relocated(replace(state, worlds=begun), change="restarts")


@lru_cache(256)
def _motion(translation: bytes, quaternion: bytes) -> optipmb.Relocation:
    """Return a motion, which publishers repeat in every message."""
    return optipmb.Relocation.of(optipmb.Pose(np.frombuffer(translation), np.frombuffer(quaternion)))


def _behind(state: FilterState, worlds: Worlds, here: int, motion: optipmb.Relocation | None) -> Relocated:
    """Return the motions from a known world to the newest, and the fault of another motion into it."""
    ahead = worlds.since(here)
    if len(ahead) < worlds.number - here:
        expected = f"a world of the last {KEPT} before {worlds.number}"
        return Relocated(state, None, fault=optipmb.FrameError("relocation.world", expected, str(here)))
    first, fault = worlds.since(here - 1)[: -len(ahead) or None], None
    if motion is not None and first and motion != first[0]:
        fault = optipmb.FrameError("relocation", f"that of world {here} before, {tuple(first[0])}", str(tuple(motion)))
    return Relocated(state, ahead, fault=fault)


def _moved(state: FilterState, worlds: Worlds, motion: optipmb.Relocation) -> FilterState:
    """Return a state whose density and places have moved."""

    def sensor(one: SensorState) -> SensorState:
        poses, place = one.pose_history, motion.place
        poses = replace(poses, position=place(poses.position), astray_position=place(poses.astray_position))
        return replace(one, pose_history=poses)

    return replace(
        state,
        density=motion.density(state.density),
        sensors={name: sensor(one) for name, one in state.sensors.items()},
        zones=None if state.zones is None else relocated_zones(state.zones, motion),
        worlds=worlds,
    )
