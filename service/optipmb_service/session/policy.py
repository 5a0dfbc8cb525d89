"""Policy: the settings that a session follows; times in nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from optipmb.model.parameters import ALIKE
from optipmb_service.units import SECOND

if TYPE_CHECKING:
    import optipmb
    from optipmb.world.zones import Zone


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
