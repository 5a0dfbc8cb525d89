"""The window of a session as a checkpoint tells it: where its frames belong, and what the tracker takes of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import optipmb
from optipmb_service.session import convert
from optipmb_service.session.checkpoint import CheckpointError
from optipmb_service.session.fused_timeline import FusedTimeline
from optipmb_service.session.state import Entry, size_of
from optipmb_service.session.timeline import Timeline

if TYPE_CHECKING:
    from optipmb_service.session.checkpoint import Checkpoint


def window_of(checkpoint: Checkpoint, gap_limit_ns: int) -> tuple[Timeline | FusedTimeline, list[Entry]]:
    """Return the timeline and the frames of the window in the order of processing.

    Args:
        checkpoint: what was written down.
        gap_limit_ns: see `Timeline`.

    Raises:
        CheckpointError: its frames do not fit together.
    """
    base = checkpoint.base
    by_frame_id = {checkpoint.frame_id(one): one for one in checkpoint.window}
    timeline: Timeline | FusedTimeline
    if checkpoint.fused:
        # A frame that was refused for its effort may have begun a generation that no frame was tracked in yet.
        head = checkpoint.head
        generation = max([head.generation, *(one.generation for one in head.cursors.values())])
        frame_ids = tuple(by_frame_id)
        timeline = FusedTimeline.resume(gap_limit_ns, checkpoint.seen, base.cursors, base.last, frame_ids, generation)
    else:
        epochs, cursor = checkpoint.seen.get("", ()), base.sensor("").cursor
        timeline = Timeline.resume(gap_limit_ns, epochs, cursor, base.last, frozenset(by_frame_id))
    places = timeline.places()
    entries: list[Entry] = []
    for frame_id, one in by_frame_id.items():
        try:
            frame, ignored = convert.frame_of(checkpoint.parameters, one.message)
        except optipmb.FrameError as error:
            raise CheckpointError(f"window: {error}") from error
        weight = size_of(one.message, one.points)
        entries.append(
            Entry(frame_id, places[frame_id], one.message, one.points, one.missed, one.revision, frame, ignored, weight)
        )
    return timeline, sorted(entries, key=lambda one: one.order)
