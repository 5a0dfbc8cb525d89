"""All streams of the service: finds the lane of a message, makes and frees lanes, and sees to those that fell silent.

Called by the readers, the workers, the query thread and the control loop; one lock guards the tables, and nothing slow
is done under it.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final

import optipmb_schemas as schemas
import structlog

import optipmb
from optipmb_service import quarantine
from optipmb_service.circle import Circle, Member, Seating
from optipmb_service.lane import Lane
from optipmb_service.ownership import Change
from optipmb_service.problems import problem_of
from optipmb_service.records import SECOND, Life, Policy, Traffic
from optipmb_service.share import Share
from optipmb_service.standby import Budget

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from optipmb_service.inbox import Pool
    from optipmb_service.keeper import Keeping
    from optipmb_service.metrics import Metrics
    from optipmb_service.ports import Outlet, Packet
    from optipmb_service.problems import Desk
    from optipmb_service.profiles import Profiles
    from optipmb_service.session import Session
    from optipmb_service.settings import Settings

log = structlog.get_logger("optipmb_service")

MAX_UNPROVEN: Final = 256
"""Lanes at once of streams that have not sent a valid message yet."""

MAX_LIVES: Final = 65_536
"""Streams without a session whose past is remembered."""

DUMPS: Final = "quarantine"
MAX_DUMPS: Final = 32

MEGABYTE: Final = 2**20

MAX_KEYS: Final = 8192
"""Keys whose stream is remembered."""


class Registry:
    """The streams of one service.

    Args:
        settings: what is in force.
        profiles: the parameters that can be had.
        outlet: where results go.
        desk: where problems go.
        pool: the workers.
        steward: says which streams this instance owns.
        keeper: where checkpoints go and come from.
        arm: has `Lane.wake` called at a monotonic time (ns).
        metrics: counts what comes and goes.
        tracker: makes the trackers of sessions.
        share: the streams of this process; all of them where it is the only one.
    """

    def __init__(  # noqa: PLR0913 - the parts that it brings together
        self,
        settings: Settings,
        profiles: Profiles,
        *,
        outlet: Outlet,
        desk: Desk,
        pool: Pool,
        steward: Seating,
        keeper: Keeping,
        arm: Callable[[Member, int], None],
        metrics: Metrics,
        tracker: Callable[[optipmb.Parameters], Any] = optipmb.Tracker,
        share: Share | None = None,
    ) -> None:
        self.share = share or Share()
        self.profiles = profiles
        self.instance = settings.instance
        self.keys = schemas.Keys(settings.prefix)
        self.limits = settings.limits.limits()
        self.cloud_wait_s = settings.cloud_wait_s
        self._settings = settings
        self._desk = desk
        self._pool = pool
        self._lock = threading.Lock()
        self._lanes: dict[str, Lane] = {}
        self._sessions = 0
        self._lives: OrderedDict[str, Life] = OrderedDict()
        self._streams: dict[str, str] = {}
        self._past = Traffic()
        self._metrics = metrics
        self._circle = Circle(
            instance=settings.instance,
            limits=self.limits,
            policy=Policy(
                gap_limit_ns=round(settings.gap_limit_s * SECOND),
                cloud_wait_ns=round(settings.cloud_wait_s * SECOND),
                cloud_memory_ns=round(settings.cloud_memory_s * SECOND),
                clouds=settings.queue_clouds,
                rewind_ns=round(settings.rewind_s * SECOND),
                late_clouds=settings.late_clouds,
                recovery_wait_ns=round(settings.recovery_wait_s * SECOND),
                max_speed=settings.max_speed,
            ),
            queue_frames=settings.queue_frames,
            queue_clouds=settings.queue_clouds,
            outlet=outlet,
            desk=desk,
            parameters_of=profiles.of,
            steward=steward,
            keeper=keeper,
            standby_ns=round(settings.standby_s * SECOND),
            dump=lambda stream, dump: _save(settings.folder, stream, dump),
            budget=Budget(settings.standby_mb * MEGABYTE),
            room=lambda: self._sessions < settings.max_sessions,
            admit=self._admit,
            release=self._release,
            discard=self._discard,
            submit=pool.submit,
            arm=arm,
            metrics=metrics,
            tracker=tracker,
        )

    # Messages, from the readers

    def wants(self, key: str) -> bool:
        """Whether a message on a key is for this process; asked before its payload is touched."""
        share = self.share
        if share.count == 1:
            return True
        try:
            return share.has(self._parsed(key))
        except schemas.MessageError:
            return share.index == 0  # a key that is none of a stream is reported by one of the processes

    def frame(self, packet: Packet) -> None:
        """Hand detections to their stream; never waits."""
        self._metrics.received("detections", packet.size)
        if (stream := self._stream_of(packet)) is not None:
            self._offer(stream, lambda lane: lane.inbox.offer_frame(packet))

    def cloud(self, packet: Packet) -> None:
        """Hand a point cloud to its stream; never waits."""
        self._metrics.received("points", packet.size)
        if (stream := self._stream_of(packet)) is not None:
            self._offer(stream, lambda lane: lane.inbox.offer_cloud(packet))

    def command(self, stream: str, command: Callable[[Lane], None], *, urgent: bool) -> bool:
        """Have a worker run a command for a stream; False when the service takes no more streams."""
        return self._offer(stream, lambda lane: lane.inbox.offer_command(lambda: command(lane), urgent=urgent))

    # What is there

    def lanes(self) -> list[Lane]:
        """Return the lanes that have a session, by stream name."""
        with self._lock:
            lanes = sorted(self._lanes.items())
        return [lane for _, lane in lanes if lane.session is not None]

    def lane(self, stream: str) -> Lane | None:
        """Return the lane of a stream that has a session."""
        with self._lock:
            lane = self._lanes.get(stream)
        return lane if lane is not None and lane.session is not None else None

    def totals(self) -> Traffic:
        """Return what became of all messages since the start."""
        with self._lock:
            totals, lanes = self._past, list(self._lanes.values())
        for lane in lanes:
            totals += lane.totals()
        return totals

    @property
    def standing_by(self) -> int:
        """Streams of which packets wait here for a takeover."""
        with self._lock:
            lanes = list(self._lanes.values())
        return sum(lane.stands_by for lane in lanes)

    @property
    def busy(self) -> bool:
        """Whether something waits to be worked on."""
        with self._lock:
            lanes = list(self._lanes.values())
        return any(not lane.inbox.idle for lane in lanes)

    # What the control loop has done now and then

    def sweep(self, now_ns: int) -> None:
        """Log streams that fell silent, close sessions that have been idle for long, or are another worker's."""
        for lane in self.lanes():
            if not self.share.has(lane.stream):
                # What was on its way while the stream was moved began a session once more.
                self.command(lane.stream, Lane.hand_over, urgent=False)
            age_s = lane.meter.age_s(now_ns)
            if age_s is not None and age_s > self._settings.stale_s and not lane.stale:
                lane.stale = True
                log.warning("stream_stale", stream=lane.stream, age_s=round(age_s, 3))
            if now_ns - lane.meter.active_ns > self._settings.idle_s * SECOND:
                self.command(lane.stream, self._close_idle, urgent=False)
        with self._lock:
            waiting = [lane for lane in self._lanes.values() if lane.stands_by]
        for lane in waiting:
            lane.tell(Lane.trim)

    def changed(self, stream: str, change: Change) -> None:
        """Tell a stream's worker that this instance owns the stream now, or does not."""
        command = Lane.take_seat if change is Change.GRANTED else Lane.give_seat
        self.command(stream, command, urgent=True)

    def resume(self) -> None:
        """Send workers to all streams: they paused, and need not any longer."""
        for lane in self.lanes():
            lane.wake()

    def keep(self) -> None:
        """Have every session that changed give its state to the keeper."""
        for lane in self.lanes():
            lane.tell(Lane.keep)

    def keep_now(self) -> None:
        """Do the same in the calling thread, when the workers have ended."""
        for lane in self.lanes():
            lane.keep()

    def finish(self) -> None:
        """Process what is held for clouds, in every session; the workers do it."""
        for lane in self.lanes():
            self.command(lane.stream, _flush, urgent=False)

    def _close_idle(self, lane: Lane) -> None:
        # Asked again: a message may have come between the sweep and the worker's turn.
        if time.monotonic_ns() - lane.meter.active_ns > self._settings.idle_s * SECOND:
            lane.close_session("idle")

    # Lanes

    def _offer(self, stream: str, offer: Callable[[Lane], bool | None]) -> bool:
        while True:
            lane = self._lane(stream)
            if lane is None:
                self._refuse(stream)
                return False
            sent = offer(lane)
            if sent is not None:
                break
            # The lane has closed since it was found: once more, with a new one.
            self._discard(lane)
        if sent:
            self._pool.submit(lane)
        return True

    def _lane(self, stream: str) -> Lane | None:
        with self._lock:
            lane = self._lanes.get(stream)
            if lane is None and self._unproven < MAX_UNPROVEN:
                lane = self._lanes[stream] = Lane(stream, self._circle)
            return lane

    @property
    def _unproven(self) -> int:
        """Lanes of streams that have not sent a valid message, as far as is known; called with the lock."""
        if len(self._lanes) < MAX_UNPROVEN:
            return 0
        return sum(not lane.proven for lane in self._lanes.values())

    def _discard(self, lane: Member) -> None:
        with self._lock:
            if self._lanes.get(lane.stream) is lane:
                del self._lanes[lane.stream]
                self._past += lane.totals()

    def _admit(self, stream: str) -> Life | None:
        with self._lock:
            if self._sessions >= self._settings.max_sessions:
                return None
            self._sessions += 1
            return self._lives.pop(stream, Life())

    def _release(self, session: Session) -> None:
        with self._lock:
            self._sessions -= 1
            self._lives[session.stream] = session.life
            if len(self._lives) > MAX_LIVES:
                self._lives.popitem(last=False)

    def _refuse(self, stream: str) -> None:
        self._count_refused()
        self._report("shed", stream, f"fewer than {MAX_UNPROVEN} new streams at once", "another one")

    def _count_refused(self) -> None:
        with self._lock:
            self._past += Traffic(received=1, refused=1)

    def _stream_of(self, packet: Packet) -> str | None:
        try:
            return self._parsed(packet.key)
        except schemas.MessageError as error:
            self._count_refused()
            self._report("invalid_value", "", error.expected, error.received)
            return None

    def _parsed(self, key: str) -> str:
        """Return the stream of a key, remembered.

        Raises:
            MessageError: it is none.
        """
        stream = self._streams.get(key)
        if stream is None:
            stream = self.keys.stream_of(key)
            if len(self._streams) >= MAX_KEYS:
                self._streams.clear()
            self._streams[key] = stream
        return stream

    def _report(self, code: str, stream: str, expected: str, received: str) -> None:
        message = f"Key: expected {expected}, received {received}."
        problem = problem_of(
            code,
            stream=stream,
            instance=self.instance,
            path="key",
            expected=expected,
            received=received,
            message=message,
        )
        self._desk.report(problem, time.monotonic_ns())


def _save(folder: Path | None, stream: str, dump: bytes) -> str:
    """Write what is needed to see an error again into the folder of the state; return the file, empty without one."""
    if folder is None:
        return ""
    try:
        return str(quarantine.save(folder / DUMPS, stream, dump, most=MAX_DUMPS))
    except OSError as error:
        log.warning("store_failed", error=str(error))
        return ""


def _flush(lane: Lane) -> None:
    if lane.session is not None:
        lane.deliver(lane.session.flush())
