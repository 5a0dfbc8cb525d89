"""The window of a session as a checkpoint tells it, and where its frames belong."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optipmb_service.session.fused_timeline import FusedTimeline
from optipmb_service.session.state import Entry, size_of
from optipmb_service.session.timeline import Timeline

if TYPE_CHECKING:
    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.session.values import JumpLimits


def window_of(checkpoint: Checkpoint, limits: JumpLimits) -> tuple[Timeline | FusedTimeline, list[Entry]]:
    """Return the timeline and the frames of the window in the order of processing.

    Args:
        checkpoint: what was written down.
        limits: see `Timeline`.
    """
    base = checkpoint.base
    frame_ids = tuple(one.frame_id for one in checkpoint.window)
    timeline: Timeline | FusedTimeline
    if checkpoint.fused:
        # A frame that was refused for its effort may have begun a generation that no frame was tracked in yet.
        head = checkpoint.head
        generation = max([head.generation, *(one.generation for one in head.cursors.values())])
        timeline = FusedTimeline.resume(
            limits.ahead_ns, checkpoint.seen, base.cursors, base.last, frame_ids, generation
        )
    else:
        epochs, cursor = checkpoint.seen.get("", ()), base.sensor("").cursor
        timeline = Timeline.resume(limits, epochs, cursor, base.last, frozenset(frame_ids))
    places = timeline.places()
    entries = [
        Entry(
            one.frame_id,
            one.detections,
            one.points,
            one.missed,
            one.revision,
            one.packed,
            places[one.frame_id],
            size_of(one.detections, one.points),
        )
        for one in checkpoint.window
    ]
    return timeline, sorted(entries, key=lambda one: one.order)
