"""Sources of the frames that a session has missed: caches of publishers, and the log of messages.

Their frames go into the backlog before all others. The session drops frames that it has tracked, or has from
another source. The log is read when a session is opened, and when it is silent: its frames may be there and not arrive,
as behind a cut between two routers.
"""

from __future__ import annotations

import contextlib
import time
from functools import partial
from typing import TYPE_CHECKING, Final

from optipmb_client.errors import ConnectionFailed as TransportError

from optipmb_service.units import SECOND

if TYPE_CHECKING:
    from optipmb_service.session.arrivals import Arrivals
    from optipmb_service.session.session import Session
    from optipmb_service.streams.backlog import Backlog
    from optipmb_service.streams.directory import StreamDirectory
    from optipmb_service.streams.parts import Parts
    from optipmb_service.streams.stream import Stream
    from optipmb_service.zenoh.topics import Packet

LOG_READS: Final = 32
"""Sessions that read the log at once: thousands that are silent are no load on its servers."""

MOST_PAUSES: Final = 8
"""Longest pause between two reads that find nothing, in times of the silence before the first one."""


class Sources:
    """Sources of one stream's sessions.

    Args:
        parts: of the process.
        directory: streams that are known.
        backlog: of the stream.
    """

    def __init__(self, parts: Parts, directory: StreamDirectory, backlog: Backlog) -> None:
        self.log_check = LogCheck(round(parts.settings.lease_s * SECOND))
        self._parts = parts
        self._directory = directory
        self._backlog = backlog

    def complete(self, session: Session, *caches: str) -> bool:
        """Note the caches of which all has been taken; return whether the frames that wait need not any longer.

        Of several sensors the caches of all must have answered. Those that were not asked yet are.
        """
        name, fusion, now_ns, arrivals = session.stream, self._parts.fusion, time.monotonic_ns(), session.arrivals
        arrivals.answer(*caches)
        if not arrivals.waiting or not fusion.is_session(name):
            return arrivals.waiting
        awaited = self._directory.awaited(
            fusion.feeds(name), lambda one: fusion.session_of(one) == name, session.sensors, now_ns
        )
        for stream in arrivals.to_ask(awaited):
            with contextlib.suppress(TransportError):  # the end
                self._parts.transport.ask_cache(stream, partial(self._arrived, arrivals, stream))
        return arrivals.complete(awaited, now_ns)

    def look_in_log(self, stream: Stream) -> None:
        """Recover what the log has of the session's sensors after their newest frames."""
        if (session := stream.session) is None or self._parts.log is None:
            self.log_check.end(found=False)
            return

        def take(packets: list[Packet]) -> None:
            self._backlog.recover(packets)
            self.log_check.end(found=bool(packets))

        self._parts.log.look(session.snapshot(), take)

    def _arrived(self, arrivals: Arrivals, cache: str, packets: list[Packet], complete: bool) -> None:  # noqa: FBT001 - as the network calls it
        """Take what a cache held; one that has not answered in full is asked again. Called on any thread."""
        self._backlog.recover(packets)
        if complete:
            self._backlog.cache_answered(cache)
        else:
            arrivals.ask_again(cache)


def read_logs(streams: list[Stream], now_ns: int) -> None:
    """Have the log read for silent sessions, those first that wait longest; a few at a time."""
    checks = [(one, one.sources.log_check) for one in streams]
    silent = ((check.due_ns(one.sensors.silent_ns(now_ns), now_ns), one, check) for one, check in checks)
    due = [(since_ns, one, check) for since_ns, one, check in silent if since_ns is not None]
    free = LOG_READS - sum(check.under_way for _, check in checks)
    for _, one, check in sorted(due, key=lambda one: one[0])[: max(0, free)]:
        check.begin(now_ns)
        if not one.backlog.command(partial(one.sources.look_in_log, one), urgent=False):
            check.end(found=False)


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
        self.under_way = True
        self._next_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, MOST_PAUSES * self._silent_ns)

    def end(self, *, found: bool) -> None:
        """End a read; where it found frames, the next one is due at once."""
        if found:
            self._pause_ns, self._next_ns = self._silent_ns, 0
        self.under_way = False
