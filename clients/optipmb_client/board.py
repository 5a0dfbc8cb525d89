"""A live view of services and streams for a terminal: what runs, how fast, what is wrong, the worst on top.

Pure: it takes one sample after the other and gives something that rich can draw. Rates are differences of counters
between samples, so they show what happens now and not the mean since the start.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from optipmb_schemas import Problem, ServiceStatus, SessionSummary
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from optipmb_client.columns import without
from optipmb_client.status import duration, profile_of

HISTORY = 40  # samples of the curve of frames per second
GONE_S = 60.0  # how long an instance that vanished stays on the board
RECENT_S = 30.0  # how long a problem is new
LATE_MS = 50.0  # latency that is worth a colour
VERY_LATE_MS = 200.0
SHOWN_PROBLEMS = 6
FRAME_LINES = 6  # lines of the board that are neither services, streams nor problems
# Columns that a narrow terminal does not show, the first ones first
SPARE = {
    "instances": ("frames/s lately", "stands by", "up", "p50 ms", "waiting"),
    "streams": ("profile", "p50 ms", "lost", "instance", "tracks", "last frame", "waiting"),
}

BARS = " ▁▂▃▄▅▆▇█"
GOOD, POOR, BAD, QUIET = "green", "yellow", "bold red", "dim"
STATES = {"ready": GOOD, "running": GOOD, "new": QUIET, "starting": POOR, "degraded": POOR, "stale": POOR}


@dataclass
class _Seen:
    """An instance as it was last seen, and what it did before."""

    status: ServiceStatus
    at_s: float
    frames_hz: float = 0.0
    lost_hz: float = 0.0
    curve: deque[float] = field(default_factory=lambda: deque(maxlen=HISTORY))


class Board:
    """What has been sampled so far.

    Args:
        where: the network, for the title.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._seen: dict[str, _Seen] = {}
        self._problems: dict[tuple[str, str, str, str], tuple[float, Problem]] = {}
        self._lost: dict[tuple[str, str], float] = {}
        self._now_s = 0.0

    def take(self, services: Sequence[ServiceStatus], now_s: float) -> None:
        """Take a sample: the status of every instance that answered at a monotonic time in seconds."""
        self._now_s = now_s
        for status in services:
            old = self._seen.get(status.instance)
            seen = _Seen(status, now_s, curve=old.curve if old else deque(maxlen=HISTORY))
            if old is not None and old.status.started_ns == status.started_ns and now_s > old.at_s:
                seconds = now_s - old.at_s
                seen.frames_hz = max(0, status.frames - old.status.frames) / seconds
                self._count_lost(status, old.status, seconds)
                seen.lost_hz = sum(self._lost.get((status.instance, one.stream), 0.0) for one in status.sessions)
                seen.curve.append(seen.frames_hz)
            self._seen[status.instance] = seen
            for problem in status.problems:
                self._note(problem)
        for instance in [name for name, seen in self._seen.items() if now_s - seen.at_s > GONE_S]:
            del self._seen[instance]

    def render(self, height: int, width: int) -> RenderableType:
        """Return the board, at most so many lines and characters; streams that are well are left out first."""
        alive = [seen for seen in self._seen.values() if seen.at_s == self._now_s]
        parts: list[RenderableType] = [self._title(alive)]
        if not self._seen:
            parts.append(Text("no service answers", style=BAD))
            return Group(*parts)
        parts += [Text(), without(self._instances(), width, SPARE["instances"])]
        problems = sorted(self._problems.values(), key=lambda noted: noted[0])[-SHOWN_PROBLEMS:]
        rows = [(seen, session) for seen in alive for session in seen.status.sessions]
        room = max(1, height - FRAME_LINES - len(self._seen) - (len(problems) + 1 if problems else 0))
        if rows:
            parts += [Text(), without(self._streams(rows, room), width, SPARE["streams"])]
        if problems:
            parts += [Text(), *(self._problem(at_s, problem) for at_s, problem in problems)]
        return Group(*parts)

    def _count_lost(self, status: ServiceStatus, before: ServiceStatus, seconds: float) -> None:
        old = {session.stream: session for session in before.sessions}
        for session in status.sessions:
            past = old.get(session.stream, session)
            lost = sum(
                max(0, getattr(session, name) - getattr(past, name)) for name in ("refused", "shed", "gaps")
            )  # fmt: skip
            self._lost[status.instance, session.stream] = lost / seconds

    def _note(self, problem: Problem) -> None:
        key = (problem.instance, problem.stream, problem.code, f"{problem.path} {problem.message} {problem.count}")
        self._problems.setdefault(key, (self._now_s, problem))
        if len(self._problems) > 10 * SHOWN_PROBLEMS:
            del self._problems[next(iter(self._problems))]

    def _title(self, alive: Sequence[_Seen]) -> Text:
        streams = sum(len(seen.status.sessions) for seen in alive)
        frames = sum(seen.frames_hz for seen in alive)
        lost = sum(seen.lost_hz for seen in alive)
        text = Text.assemble(("OptiPMB", "bold"), f"  {self._where}   ")
        text.append(f"{_counted(len(alive), 'service')}, {_counted(streams, 'stream')}, ")
        text.append(f"{frames:.0f} frames/s", style="bold")
        text.append(f", {lost:.1f} lost/s", style=BAD if lost else QUIET)
        return text

    def _instances(self) -> Table:
        table = _table(
            ("instance", "state", "up"), ("streams", "stands by", "frames/s", "lost/s", "waiting", "p50 ms", "p99 ms")
        )
        table.add_column("frames/s lately", no_wrap=True)
        for name, seen in sorted(self._seen.items()):
            sessions = seen.status.sessions
            if seen.at_s != self._now_s:
                gone = f"gone for {duration(self._now_s - seen.at_s)}"
                table.add_row(name, Text(gone, style=BAD), "", *[""] * 7, Text(_curve(seen.curve), style=QUIET))
                continue
            table.add_row(
                name,
                _state(seen.status.state),
                duration(seen.status.uptime_s),
                str(len(sessions)),
                str(seen.status.standby),
                f"{seen.frames_hz:.1f}",
                _lost(seen.lost_hz),
                str(sum(session.queue for session in sessions)),
                f"{_median([session.latency_p50_ms for session in sessions]):.1f}",
                _latency(max((session.latency_p99_ms for session in sessions), default=0.0)),
                _curve(seen.curve),
            )
        return table

    def _streams(self, rows: list[tuple[_Seen, SessionSummary]], room: int) -> Table:
        several = len(self._seen) > 1
        names = ("stream", *(("instance",) if several else ()), "profile", "state")
        figures = ("frames/s", "p50 ms", "p99 ms", "tracks", "waiting", "lost/s", "lost", "last frame")
        table = _table(names, figures)
        ordered = sorted(rows, key=lambda row: (-self._urgency(*row), row[1].stream))
        shown = ordered if len(ordered) <= room else ordered[: room - 1]
        for seen, session in shown:
            instance = seen.status.instance
            table.add_row(
                session.stream,
                *([instance] if several else []),
                profile_of(session),
                _state(session.state),
                f"{session.rate_hz:.1f}",
                f"{session.latency_p50_ms:.1f}",
                _latency(session.latency_p99_ms),
                str(session.tracks),
                Text(str(session.queue), style=POOR if session.queue > session.rate_hz + 1 else ""),
                _lost(self._lost.get((instance, session.stream), 0.0)),
                str(session.refused + session.shed + session.gaps),
                "never" if session.age_s is None else duration(session.age_s),
            )
        if len(shown) < len(ordered):
            table.add_row(Text(f"and {len(ordered) - len(shown)} more in better state", style=QUIET))
        return table

    def _urgency(self, seen: _Seen, session: SessionSummary) -> float:
        """How much a stream wants to be looked at: losses first, then silence, then waiting and lateness."""
        losing = 1e6 * (self._lost.get((seen.status.instance, session.stream), 0.0) > 0)
        silent = 1e5 * (session.state not in {"running", "new"})
        return losing + silent + 100 * (session.queue > session.rate_hz + 1) + (session.latency_p99_ms // LATE_MS)

    def _problem(self, at_s: float, problem: Problem) -> Text:
        age = self._now_s - at_s
        times = f" ({problem.count} times)" if problem.count > 1 else ""
        style = POOR if age < RECENT_S else QUIET
        return Text(
            f"{duration(age):>8} ago  {problem.code:<16} {problem.stream or 'no stream'}: {problem.message}{times}",
            style=style,
            no_wrap=True,
            overflow="ellipsis",
        )


def _table(names: Iterable[str], figures: Iterable[str]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in names:
        table.add_column(name, no_wrap=True, overflow="ellipsis")
    for name in figures:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _counted(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"


def _state(state: str) -> Text:
    return Text(state, style=STATES.get(state, BAD))


def _lost(per_second: float) -> Text:
    return Text(f"{per_second:.1f}", style=BAD if per_second else QUIET)


def _latency(milliseconds: float) -> Text:
    style = BAD if milliseconds > VERY_LATE_MS else POOR if milliseconds > LATE_MS else ""
    return Text(f"{milliseconds:.1f}", style=style)


def _curve(values: Iterable[float]) -> str:
    """Draw values as bars, the greatest as a full one."""
    known = list(values)
    most = max(known, default=0.0)
    if most <= 0.0:
        return BARS[0] * len(known)
    return "".join(BARS[round(value / most * (len(BARS) - 1))] for value in known)


def _median(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2] if values else 0.0
