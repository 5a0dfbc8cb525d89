"""The services and streams of a network as a table."""

from collections.abc import Sequence

from optipmb_schemas import Problem, ServiceStatus, SessionSummary
from rich.console import Group, JustifyMethod, RenderableType
from rich.table import Table
from rich.text import Text

__all__ = ["duration", "render"]

COLUMNS = ("stream", "profile", "state", "frames/s", "p50 ms", "p99 ms", "frames", "tracks", "queue")
COUNTED = ("refused", "shed", "gaps", "last frame")
TEXTS = 3
"""Columns of texts; the others are of numbers."""

SHOWN_PROBLEMS = 5


def render(services: Sequence[ServiceStatus]) -> RenderableType:
    """Return services with their streams and newest problems, ready to be printed."""
    parts: list[RenderableType] = []
    for service in services:
        head = f"{service.instance}  {service.state}, version {service.version}, up {duration(service.uptime_s)}, "
        parts.append(Text(head + f"{service.frames} frames, {service.refused} refused", style="bold"))
        parts.append(_streams(service.sessions) if service.sessions else Text("no streams"))
        parts += [_problem(problem) for problem in service.problems[-SHOWN_PROBLEMS:]]
    return Group(*parts)


def _streams(sessions: Sequence[SessionSummary]) -> Table:
    table = Table(box=None, pad_edge=False)
    for number, name in enumerate(COLUMNS + COUNTED):
        side: JustifyMethod = "right" if number >= TEXTS else "default" if number else "left"
        table.add_column(name, justify=side, no_wrap=True)  # of a table in parts, each has the columns on the left
    for session in sessions:
        table.add_row(
            session.stream,
            session.profile,
            session.state,
            f"{session.rate_hz:.1f}",
            f"{session.latency_p50_ms:.1f}",
            f"{session.latency_p99_ms:.1f}",
            str(session.frames),
            str(session.tracks),
            str(session.queue),
            str(session.refused),
            str(session.shed),
            str(session.gaps),
            "never" if session.age_s is None else f"{duration(session.age_s)} ago",
        )
        for sensor in session.sensors:
            table.add_row(f"  {sensor}", "", "silent" if sensor in session.silent else "feeds it")
    return table


def _problem(problem: Problem) -> Text:
    times = f" ({problem.count} times)" if problem.count > 1 else ""
    return Text(f"problem: {problem.stream or 'no stream'}: {problem.message}{times}", style="yellow")


def duration(seconds: float) -> str:
    """Return a time in seconds as people say it."""
    for unit, size in (("d", 86_400), ("h", 3_600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.1f} s"
