"""Recovery of frames that a session has missed, from the log of messages."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import structlog

from optipmb_service.cluster.store import LogQuery, Position
from optipmb_service.session.timeline import number_of
from optipmb_service.zenoh.topics import Packet

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    import optipmb_schemas as schemas

    from optipmb_service.cluster.message_log import LogMessage, LogReader
    from optipmb_service.session.checkpoint import Checkpoint
    from optipmb_service.streams.profiles import Fusion

    Take = Callable[[list[Packet]], None]

log = structlog.get_logger("optipmb_service")


class Log:
    """Frames and tracks in the log.

    Args:
        reader: reads it; closed with this.
        keys: the keys of streams.
        fusion: sensors that share a session.
    """

    def __init__(self, reader: LogReader, keys: schemas.Keys, fusion: Fusion) -> None:
        self._reader = reader
        self._keys = keys
        self._fusion = fusion

    def fetch(self, session: str, checkpoint: Checkpoint | None, first: Take, later: Take) -> None:
        """Call `first` soon, once in any case, with the frames after a checkpoint, and `later` with further ones.

        They are called on a thread that they must not keep.
        """
        fused = self._fusion.is_session(session)
        if checkpoint is not None and checkpoint.fused and not checkpoint.seen:
            first([])  # it was closed by a query, and has forgotten its frames
            return
        takes = iter((first,))
        try:
            wanted = LogQuery(
                streams=() if fused else (session,),
                common=self._fusion.feeds(session) if fused else "",
                belongs=lambda stream: self._fusion.session_of(stream) == session,
                positions={} if checkpoint is None else positions_of(checkpoint),
            )
            self._reader.missed(wanted, lambda messages: next(takes, later)(self._packets(messages)))
        except Exception:
            log.exception("internal_error", stream=session)
            first([])

    def look(self, checkpoint: Checkpoint, then: Take) -> None:
        """Call `then` soon, once, with the frames after the newest ones of a checkpoint."""
        positions = newest_of(checkpoint)
        wanted = LogQuery(tuple(positions), common="", belongs=lambda _: False, positions=positions)
        self._reader.missed(wanted, lambda messages: then(self._packets(messages)), again_s=())

    def tracks(
        self, stream: str, from_ns: int, take: Callable[[Sequence[LogMessage]], bool], end: Callable[[str], None]
    ) -> None:
        """Read the tracks of a stream from a stamp on; see `LogReader.tracks`."""
        self._reader.tracks(stream, from_ns, take, end)

    def close(self, timeout: float) -> None:
        self._reader.close(timeout)

    def _packets(self, messages: Iterable[LogMessage]) -> list[Packet]:
        now = time.time_ns(), time.monotonic_ns()
        key = self._keys.detections
        return [Packet(key(one.stream), one.payload, len(one.payload), one.encoding, *now) for one in messages]


def newest_of(checkpoint: Checkpoint) -> dict[str, Position]:
    """Return, for each sensor of a session, the newest frame that has come."""
    return {
        name or checkpoint.stream: Position(
            frozenset(one.epoch for one in epochs[:-1]), epochs[-1].epoch, epochs[-1].highest, tracked=True
        )
        for name, epochs in checkpoint.seen.items()
        if epochs
    }


def positions_of(checkpoint: Checkpoint) -> dict[str, Position]:
    """Return, for each sensor of a session, the last frame before the window of a checkpoint.

    Where all frames of a sensor are in the window, it is the one before the first of them.
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
