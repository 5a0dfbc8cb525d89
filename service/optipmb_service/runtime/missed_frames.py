"""What a session has missed while nobody tracked it, from the log: one more source beside the caches of publishers.

What comes from several sources, or was tracked already, the session drops. The log is read when a session is opened,
and when one is silent (`LogCheck`): its frames may be there and not arrive, as behind a cut between two routers.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final, Protocol

import structlog

from optipmb_service.cluster.log_position import Missed, Position
from optipmb_service.runtime.ports import Packet
from optipmb_service.session.timeline import number_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import optipmb_schemas as schemas

    from optipmb_service.cluster.message_log import LogMessage, LogReader
    from optipmb_service.runtime.fusion import Fusion
    from optipmb_service.session.checkpoint import Checkpoint

    Take = Callable[[list[tuple[Packet, bool]]], None]


log = structlog.get_logger("optipmb_service")

MOST_PAUSES: Final = 8
"""Longest pause between two reads that find nothing, in times of the silence before the first one."""


class MissedFrames(Protocol):
    """Where the frames are that a session has missed."""

    def fetch(self, session: str, checkpoint: Checkpoint | None, first: Take, later: Take) -> None:
        """Have `first` called soon, once in any case, with what came after a checkpoint, and `later` with what follows.

        Both take packets, each with whether it is a frame, on a thread that they must not keep.
        """

    def look(self, checkpoint: Checkpoint, then: Take) -> None:
        """Have `then` called soon, once, with what came after the newest frames of a checkpoint."""

    def close(self, timeout: float) -> None:
        """End."""


class NoLog:
    """Without a log there is nothing."""

    def fetch(self, session: str, checkpoint: Checkpoint | None, first: Take, later: Take) -> None:
        """Go on at once."""
        del session, checkpoint, later
        first([])

    def look(self, checkpoint: Checkpoint, then: Take) -> None:
        """Find nothing."""
        del checkpoint
        then([])

    def close(self, timeout: float) -> None:
        """Nothing is open."""


class LoggedFrames:
    """The frames that are in the log.

    Args:
        reader: reads it; closed with this.
        keys: the keys of streams.
        fusion: which streams share a session.
    """

    def __init__(self, reader: LogReader, keys: schemas.Keys, fusion: Fusion) -> None:
        self._reader = reader
        self._keys = keys
        self._fusion = fusion

    def fetch(self, session: str, checkpoint: Checkpoint | None, first: Take, later: Take) -> None:
        """Have the log read."""
        fused = self._fusion.is_session(session)
        if checkpoint is not None and checkpoint.fused and not checkpoint.seen:
            first([])  # it was closed by a query, and knows no longer what it has tracked
            return
        takes = iter((first,))
        try:
            wanted = Missed(
                streams=() if fused else (session,),
                node=session.rpartition("/")[0] if fused else "",
                belongs=lambda stream: self._fusion.session_of(stream) == session,
                positions={} if checkpoint is None else positions_of(checkpoint),
            )
            self._reader.missed(wanted, lambda messages: next(takes, later)(self._packets(messages)))
        except Exception:
            log.exception("internal_error", stream=session)
            first([])

    def look(self, checkpoint: Checkpoint, then: Take) -> None:
        """Have the log read once, for the streams that have fed the session of a checkpoint."""
        positions = newest_of(checkpoint)
        wanted = Missed(tuple(positions), node="", belongs=lambda _: False, positions=positions)
        self._reader.missed(wanted, lambda messages: then(self._packets(messages)), again_s=())

    def close(self, timeout: float) -> None:
        """Close the connection."""
        self._reader.close(timeout)

    def _packets(self, messages: Iterable[LogMessage]) -> list[tuple[Packet, bool]]:
        wall_ns, now_ns = time.time_ns(), time.monotonic_ns()
        return [
            (
                Packet(self._keys.detections(one.stream), one.payload, len(one.payload), one.encoding, wall_ns, now_ns),
                True,
            )
            for one in messages
        ]


def newest_of(checkpoint: Checkpoint) -> dict[str, Position]:
    """Return, for each stream of a session, the newest frame that has come."""
    return {
        name or checkpoint.stream: Position(
            frozenset(one.epoch for one in epochs[:-1]), epochs[-1].epoch, epochs[-1].highest, tracked=True
        )
        for name, epochs in checkpoint.seen.items()
        if epochs
    }


def positions_of(checkpoint: Checkpoint) -> dict[str, Position]:
    """Return, for each stream of a session, the last frame before the window of a checkpoint.

    Where all frames of a stream are in the window, it is the one before the first of them.
    """
    positions = {}
    for name, epochs in checkpoint.seen.items():
        cursor = checkpoint.base.sensor(name).cursor
        if cursor.epoch is not None:
            before = epochs[: max(0, number_of(epochs, cursor.epoch))]
            at = Position(frozenset(one.epoch for one in before), cursor.epoch, cursor.seq, tracked=True)
        else:
            ids = [one.frame_id for one in checkpoint.window if one.frame_id.sensor == name]
            if not ids:
                continue
            first = min(ids, key=lambda one: (number_of(epochs, one.epoch), one.seq))
            at = Position(frozenset(), first.epoch, first.seq - 1, tracked=False)
        positions[name or checkpoint.stream] = at
    return positions


class LogCheck:
    """Schedule of the reads of the log for one session whose frames do not arrive.

    The control loop begins a read; the tracking thread, or the thread of the log, ends it.

    Args:
        silent_ns: silence after which the log is read; pauses double up to `MOST_PAUSES` times as long.
    """

    def __init__(self, silent_ns: int) -> None:
        self._silent_ns = self._pause_ns = silent_ns
        self._next_ns = 0
        self.under_way = False

    def due_ns(self, age_ns: int, now_ns: int) -> int | None:
        """Return since when the log is to be read; None: it is not now.

        Args:
            age_ns: time since the last frame of the sensor that is silent for longest.
            now_ns: monotonic time.
        """
        if age_ns < self._silent_ns:
            self._pause_ns, self._next_ns = self._silent_ns, 0
        waits = self.under_way or now_ns < self._next_ns or age_ns < self._silent_ns
        return None if waits else self._next_ns

    def begin(self, now_ns: int) -> None:
        """Begin a read."""
        self.under_way = True
        self._next_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, MOST_PAUSES * self._silent_ns)

    def end(self, *, found: bool) -> None:
        """End a read; where it found frames, the next one is due at once."""
        if found:
            self._pause_ns, self._next_ns = self._silent_ns, 0
        self.under_way = False
