"""The services, streams and members of a network as tables."""

import re
from collections.abc import Iterable, Sequence

from optipmb_schemas import MemberSummary, Problem, ServiceStatus, SessionSummary
from rich.console import Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

COLUMNS = ("stream", "profile", "state", "frames/s", "p50 ms", "p99 ms", "frames", "tracks", "queue")
COUNTED = ("refused", "shed", "late", "gaps", "duplicates", "last frame")
TEXTS = 3  # columns of texts; the others are of numbers

SHOWN_PROBLEMS = 5

WORKER = re.compile(r"-w\d+$")  # what follows the instance in the name of one of its workers

NAME = 32  # characters of a member's name in a line


def render(services: Sequence[ServiceStatus]) -> RenderableType:
    """Return services with their streams and newest problems, ready to be printed."""
    parts: list[RenderableType] = []
    for service in services:
        head = f"{service.instance}  {service.state}, version {service.version}, up {duration(service.uptime_s)}, "
        parts.append(Text(head + f"{service.frames} frames, {service.refused} refused", style="bold"))
        parts.append(_streams(service.sessions) if service.sessions else Text("no streams"))
        parts += [_problem(problem) for problem in service.problems[-SHOWN_PROBLEMS:]]
    members = members_of(services)
    return Group(*parts, _members(members)) if len(members) > 1 else Group(*parts)


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
        table.add_column(name, justify=side, no_wrap=True)  # of a table in parts, each has the columns on the left
    for session in sessions:
        table.add_row(
            session.stream,
            profile_of(session),
            session.state,
            f"{session.rate_hz:.1f}",
            f"{session.latency_p50_ms:.1f}",
            f"{session.latency_p99_ms:.1f}",
            str(session.frames),
            str(session.tracks),
            str(session.queue),
            str(session.refused),
            str(session.shed),
            str(session.late),
            str(session.gaps),
            str(session.duplicates),
            "never" if session.age_s is None else f"{duration(session.age_s)} ago",
        )
        for sensor in session.sensors:
            table.add_row(f"  {sensor}", "", "silent" if sensor in session.silent else "feeds it")
    return table


def profile_of(session: SessionSummary) -> str:
    """Return the profile of a session, and that of the settings where it is another one."""
    return session.profile if session.configured is None else f"{session.profile} (settings: {session.configured})"


def _problem(problem: Problem) -> Text:
    times = f" ({problem.count} times)" if problem.count > 1 else ""
    return Text(f"problem: {problem.stream or 'no stream'}: {problem.message}{times}", style="yellow")


def duration(seconds: float) -> str:
    """Return a time in seconds as people say it."""
    for unit, size in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.1f} s"
