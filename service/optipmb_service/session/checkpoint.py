"""What a session is made of between two frames, as a value that never changes; `checkpoint_codec` has its bytes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

from optipmb_service.session.state import FrameCounts
from optipmb_service.session.values import Deliveries, Lineage

if TYPE_CHECKING:
    from collections.abc import Mapping

    import optipmb
    from optipmb_service.session.state import FilterState, ProcessedFrame
    from optipmb_service.session.timeline import SeenNumbers

_SOFTWARE: Final = version("optipmb")


class CheckpointError(ValueError):
    """The bytes are no checkpoint that this service can read; the text says why.

    `lineage` has the ids that the session used, where the checkpoint is whole and of another version; else None.
    """

    def __init__(self, text: str, lineage: Lineage | None = None) -> None:
        super().__init__(text)
        self.lineage = lineage


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """What a session is made of, between two frames. Nothing in it changes any more.

    Attributes:
        stream: `site/node/sensor`; that of the tracks, where several sensors feed the session.
        parameters: the profile.
        fused: whether several sensors feed it.
        cloud_wait_ns: the wait for clouds that was asked for, None where the service's own holds.
        quarantine: the error for which frames of a sensor are refused, by sensor.
        seen: which frames came, by sensor.
        base: the state before the window.
        window: the frames of the window.
        head: the present state.
        deliveries: what was not tracked, and what was corrected.
        newest_cloud_ns: stamp of the cloud that arrived last, by sensor.
        run: see `Session.run`: the sum of the fences under which the session began and was taken up again.
        software: version of the service that wrote it.
    """

    stream: str
    parameters: optipmb.Parameters
    fused: bool
    cloud_wait_ns: int | None
    quarantine: Mapping[str, str]
    seen: Mapping[str, tuple[SeenNumbers, ...]]
    base: FilterState
    window: tuple[ProcessedFrame, ...]
    head: FilterState
    deliveries: Deliveries
    newest_cloud_ns: Mapping[str, int]
    run: int = 0
    software: str = _SOFTWARE

    @property
    def session(self) -> str:
        """The id of the present life of the density."""
        return self.head.session


def forgotten(checkpoint: Checkpoint) -> Checkpoint:
    """Return a checkpoint of a session that was reset, without its counts: what remains of a stream that was closed."""
    state = replace(checkpoint.head, counts=FrameCounts())
    seen = checkpoint.seen
    if checkpoint.fused:  # the next frames may have any clock
        state, seen = replace(state, last=None, sensors={}), {}
    return replace(checkpoint, seen=seen, base=state, head=state, window=(), deliveries=Deliveries())
