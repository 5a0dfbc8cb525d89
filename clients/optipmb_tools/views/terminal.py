"""Services and streams in a terminal: once as tables (`status_tables`), or continuously (`StatusView`).

`StatusView` takes one sample after the other and renders it. Rates are differences of counters between samples, so they
show what happens now and not the mean since the start.
"""

import re
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from statistics import median_high

from optipmb_schemas import MemberSummary, Problem, ServiceStatus, SessionSummary
from rich.console import Console, Group, JustifyMethod, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

COLUMNS = ("stream", "profile", "state", "frames/s", "p50 ms", "p99 ms", "frames", "tracks", "queue")
COUNTED = ("refused", "shed", "late", "gaps", "duplicates", "last frame")
JOINING = ("tracks joined over gaps", "lost objects", "lost objects dropped", "frames with ignored embeddings")
TEXTS = 3  # columns of texts; the others are of numbers
LISTED_PROBLEMS = 5
WORKER = re.compile(r"-w\d+$")  # follows the instance in the name of one of its workers
NAME = 32  # characters of the name of a stream or member in a line

HISTORY = 40  # samples of the curve of frames per second
GONE_S = 60.0  # how long an instance that vanished stays in the view
RECENT_S = 30.0  # how long a problem is new
LATE_MS = 50.0  # latency that is worth a colour
VERY_LATE_MS = 200.0
SHOWN_PROBLEMS = 6
FIGURES = 38  # characters of the columns of a narrow view without the stream
FRAME_LINES = 6  # lines of the view that are neither services, streams nor problems
# Columns that a narrow terminal does not show, the first ones first
SPARE = {
    "instances": ("frames/s lately", "stands by", "up", "p50 ms", "waiting"),
    "streams": ("profile", "p50 ms", "lost", "instance", "tracks", "last frame", "waiting"),
}
BARS = " ▁▂▃▄▅▆▇█"
GOOD, POOR, BAD, QUIET = "green", "yellow", "bold red", "dim"
STATES = {"ready": GOOD, "running": GOOD, "new": QUIET, "starting": POOR, "degraded": POOR, "stale": POOR}


def status_tables(services: Sequence[ServiceStatus]) -> Group:
    """Return services with their streams and newest problems, ready to be printed."""
    shown: list[RenderableType] = []
    for service in services:
        head = f"{service.instance}  {service.state}, version {service.version}, up {duration(service.uptime_s)}, "
        shown.append(Text(head + f"{service.frames} frames, {service.refused} refused", style="bold"))
        shown.append(_streams(service.sessions) if service.sessions else Text("no streams"))
        for each in service.sessions:
            shown += [Text(f"{each.stream}: learned {'; '.join(each.learned)}")] if each.learned else []
            known = each.rejoined, each.lost_objects, each.lost_dropped, each.embedding_ignored
            joining = [f"{count} {text}" for count, text in zip(known, JOINING, strict=True) if count]
            shown += [Text(f"{each.stream}: {', '.join(joining)}")] if joining else []
        for one in service.problems[-LISTED_PROBLEMS:]:
            text = f"problem: {one.stream or 'no stream'}: {one.message}{_times(one)}"
            shown.append(Text(text, style="yellow"))
    members = members_of(services)
    return Group(*shown, _members(members)) if len(members) > 1 else Group(*shown)


def members_of(services: Iterable[ServiceStatus]) -> list[MemberSummary]:
    """Return the members that services know, by name: each as it knows itself, else as who heard of it last does."""
    members: dict[str, tuple[bool, float, MemberSummary]] = {}
    for service in services:
        for one in service.members:
            name = one.member.rpartition("/")[0]
            own = service.instance in {name, WORKER.sub("", name)}
            known = (not own, one.age_s, one)
            if one.member not in members or known[:2] < members[one.member][:2]:
                members[one.member] = known
    return [members[name][2] for name in sorted(members)]


def _members(members: Sequence[MemberSummary]) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("member", overflow="fold", max_width=NAME)
    table.add_column("state")
    for name in ("partitions", "lease age", "newest fence"):
        table.add_column(name, justify="right", no_wrap=True)
    for one in members:
        fence = str(max(one.fences)) if one.fences else ""
        table.add_row(one.member, one.state, str(len(one.partitions)), duration(one.age_s), fence)
    return table


def _streams(sessions: Sequence[SessionSummary]) -> Table:
    table = Table(box=None, pad_edge=False)
    for number, name in enumerate(COLUMNS + COUNTED):
        side: JustifyMethod = "right" if number >= TEXTS else "default" if number else "left"
        # Of a table in parts, each has the columns on the left.
        table.add_column(name, justify=side, no_wrap=number >= TEXTS, overflow="fold", max_width=NAME)
    for one in sessions:
        rates = (f"{value:.1f}" for value in (one.rate_hz, one.latency_p50_ms, one.latency_p99_ms))
        counts = (one.frames, one.tracks, one.queue, one.refused, one.shed, one.late, one.gaps, one.duplicates)
        last = "never" if one.age_s is None else f"{duration(one.age_s)} ago"
        table.add_row(one.stream, profile_of(one), one.state, *rates, *map(str, counts), last)
        for sensor in one.sensors:
            table.add_row(f"  {sensor}", "", "silent" if sensor in one.silent else "feeds it")
    return table


def profile_of(session: SessionSummary) -> str:
    """Return the profile of a session, and the one of the settings if it differs."""
    return session.profile if session.configured is None else f"{session.profile}, not {session.configured}"


def duration(seconds: float) -> str:
    """Return a time in seconds in the unit that fits it."""
    for unit, size in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.1f} s"


def _times(problem: Problem) -> str:
    return f" ({problem.count} times)" if problem.count > 1 else ""


@dataclass
class _InstanceView:
    """Last status of an instance, and its rates."""

    status: ServiceStatus
    at_s: float
    frames_hz: float = 0.0
    lost_hz: dict[str, float] = field(default_factory=dict)
    """By stream."""
    curve: deque[float] = field(default_factory=lambda: deque(maxlen=HISTORY))


class StatusView:
    """Samples of all services so far.

    Args:
        where: The network, for the title.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._seen: dict[str, _InstanceView] = {}
        self._problems: dict[tuple[str, str, str, str], tuple[float, Problem]] = {}
        self._now_s = 0.0

    def take(self, services: Sequence[ServiceStatus], now_s: float) -> None:
        """Take a sample: the status of every instance that answered at a monotonic time in seconds."""
        self._now_s = now_s
        for status in services:
            old = self._seen.get(status.instance)
            seen = _InstanceView(status, now_s, curve=old.curve if old else deque(maxlen=HISTORY))
            if old is not None and old.status.started_ns == status.started_ns and now_s > old.at_s:
                seconds = now_s - old.at_s
                seen.frames_hz = max(0, status.frames - old.status.frames) / seconds
                seen.lost_hz = _lost_hz(status, old.status, seconds)
                seen.curve.append(seen.frames_hz)
            self._seen[status.instance] = seen
            for one in status.problems:
                key = (one.instance, one.stream, one.code, f"{one.path} {one.message} {one.count}")
                self._problems.setdefault(key, (now_s - _age_s(status, one), one))
                if len(self._problems) > 10 * SHOWN_PROBLEMS:
                    del self._problems[next(iter(self._problems))]
        for instance in [name for name, seen in self._seen.items() if now_s - seen.at_s > GONE_S]:
            del self._seen[instance]

    def render(self, height: int, width: int) -> RenderableType:
        """Return the view in at most `height` lines of `width` characters; healthy streams are left out first."""
        alive = [seen for seen in self._seen.values() if seen.at_s == self._now_s]
        shown: list[RenderableType] = [self._title(alive)]
        if not self._seen:
            return Group(*shown, Text("no service answers", style=BAD))
        shown += [Text(), without(self._instances(), width, SPARE["instances"])]
        problems = sorted(self._problems.values(), key=lambda noted: noted[0])[-SHOWN_PROBLEMS:]
        rows = [(seen, session) for seen in alive for session in seen.status.sessions]
        room = max(1, height - FRAME_LINES - len(self._seen) - (len(problems) + 1 if problems else 0))
        if rows:
            shown += [Text(), without(self._streams(rows, room, width - FIGURES), width, SPARE["streams"])]
        if problems:
            shown += [Text(), *(self._problem(at_s, problem) for at_s, problem in problems)]
        return Group(*shown)

    def _title(self, alive: Sequence[_InstanceView]) -> Text:
        streams = sum(len(seen.status.sessions) for seen in alive)
        frames = sum(seen.frames_hz for seen in alive)
        lost = sum(sum(seen.lost_hz.values()) for seen in alive)
        text = Text.assemble(("OptiPMB", "bold"), f"  {self._where}   ")
        text.append(f"{_counted(len(alive), 'service')}, {_counted(streams, 'stream')}, ")
        text.append(f"{frames:.0f} frames/s", style="bold")
        text.append(f", {lost:.1f} lost/s", style=BAD if lost else QUIET)
        return text

    def _instances(self) -> Table:
        figures = ("streams", "stands by", "frames/s", "lost/s", "waiting", "p50 ms", "p99 ms")
        table = _table(("instance", "state", "up"), figures)
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
                _lost(sum(seen.lost_hz.values())),
                str(sum(session.queue for session in sessions)),
                f"{median_high([session.latency_p50_ms for session in sessions] or [0.0]):.1f}",
                _latency(max((session.latency_p99_ms for session in sessions), default=0.0)),
                _curve(seen.curve),
            )
        return table

    def _streams(self, rows: list[tuple[_InstanceView, SessionSummary]], room: int, longest: int) -> Table:
        several = len(self._seen) > 1
        names = ("stream", *(("instance",) if several else ()), "profile", "state")
        figures = ("frames/s", "p50 ms", "p99 ms", "tracks", "waiting", "lost/s", "lost", "last frame")
        table = _table(names, figures)
        ordered = sorted(rows, key=lambda row: (-self._urgency(*row), row[1].stream))
        shown = ordered if len(ordered) <= room else ordered[: room - 1]
        for seen, session in shown:
            instance = seen.status.instance
            table.add_row(
                _short(session.stream, longest),
                *([instance] if several else []),
                profile_of(session),
                _state(session.state),
                f"{session.rate_hz:.1f}",
                f"{session.latency_p50_ms:.1f}",
                _latency(session.latency_p99_ms),
                str(session.tracks),
                Text(str(session.queue), style=POOR if session.queue > session.rate_hz + 1 else ""),
                _lost(seen.lost_hz.get(session.stream, 0.0)),
                str(session.refused + session.shed + session.gaps),
                "never" if session.age_s is None else duration(session.age_s),
            )
        if len(shown) < len(ordered):
            table.add_row(Text(f"and {len(ordered) - len(shown)} more in better state", style=QUIET))
        return table

    def _urgency(self, seen: _InstanceView, session: SessionSummary) -> float:
        """Return how urgent a stream is: losses first, then silence, then waiting and lateness."""
        losing = 1e6 * (seen.lost_hz.get(session.stream, 0.0) > 0)
        silent = 1e5 * (session.state not in {"running", "new"})
        return losing + silent + 100 * (session.queue > session.rate_hz + 1) + (session.latency_p99_ms // LATE_MS)

    def _problem(self, at_s: float, problem: Problem) -> Text:
        age = self._now_s - at_s
        text = f"{_short(problem.stream or 'no stream', NAME)}: {problem.message}{_times(problem)}"
        style = POOR if age < RECENT_S else QUIET
        line = f"{duration(age):>8} ago  {text}"
        return Text(line, style=style, no_wrap=True, overflow="ellipsis")


def _age_s(status: ServiceStatus, problem: Problem) -> float:
    """Return how long ago a service reported a problem, by its clock; 0 where it does not say."""
    if problem.reported_ns is None:
        return 0.0
    return max(0.0, status.uptime_s - (problem.reported_ns - status.started_ns) / 1e9)


def _lost_hz(status: ServiceStatus, before: ServiceStatus, seconds: float) -> dict[str, float]:
    """Return the frames per second that each stream has lost since a status before."""
    lost_hz = {}
    old = {session.stream: session for session in before.sessions}
    for session in status.sessions:
        past = old.get(session.stream, session)
        lost = (max(0, getattr(session, name) - getattr(past, name)) for name in ("refused", "shed", "gaps"))
        lost_hz[session.stream] = sum(lost) / seconds
    return lost_hz


def _table(names: Iterable[str], figures: Iterable[str]) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for name in names:
        table.add_column(name, no_wrap=True, overflow="ellipsis")
    for name in figures:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _short(name: str, longest: int) -> str:
    """Cut a name in the middle: streams of one site differ at the end."""
    return name if len(name) <= longest else f"{name[: longest // 4]}…{name[longest // 4 + 1 - longest :]}"


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


def parts(table: Table, width: int) -> Iterator[Table]:
    """Yield a table in parts that fit a width; its leading columns that are aligned left stand in each of them."""
    widths = _widths(table)
    lead = [place for place in range(len(widths)) if all(one.justify == "left" for one in table.columns[: place + 1])]
    taken, used = list(lead), sum(widths[place] for place in lead)
    for place in range(len(lead), len(widths)):
        if used + widths[place] - _space(table) > width and taken != lead:
            yield _only(table, taken)
            taken, used = list(lead), sum(widths[one] for one in lead)
        taken.append(place)
        used += widths[place]
    yield _only(table, taken)


def without(table: Table, width: int, spare: Sequence[str]) -> Table:
    """Return a table that fits a width: without the first ones of the columns with these headers, if it must."""
    widths = _widths(table)
    taken = list(range(len(widths)))
    for header in spare:
        if sum(widths[place] for place in taken) - _space(table) <= width:
            break
        taken = [place for place in taken if table.columns[place].header != header]
    return _only(table, taken)


def _widths(table: Table) -> list[int]:
    """Return the width of each column, with the space to the next."""
    console = Console(width=10_000)
    alone = (_only(table, [place]) for place in range(len(table.columns)))
    return [Measurement.get(console, console.options, one).maximum + _space(table) for one in alone]


def _space(table: Table) -> int:
    return 2 if table.box is None else 3


def _only(table: Table, places: Sequence[int]) -> Table:
    part = Table(
        box=table.box,
        pad_edge=table.pad_edge,
        title=table.title,
        title_justify=table.title_justify,
        header_style=table.header_style,
    )
    for place in places:
        column = table.columns[place]
        part.add_column(
            column.header,
            justify=column.justify,
            no_wrap=column.no_wrap,
            overflow=column.overflow,
            max_width=column.max_width,
        )
    for row in zip(*(table.columns[place].cells for place in places), strict=True):
        part.add_row(*row)
    return part
