"""The live view: rates from differences, the worst on top, what vanished still seen."""

import io
from typing import Any

import pytest
from optipmb_schemas import Problem, ServiceStatus, SessionSummary
from optipmb_tools.views.terminal import StatusView, parts, status_tables
from rich.console import Console
from rich.table import Table

HEIGHT = 40
SECOND = 1_000_000_000


def session(stream: str, **changes: Any) -> SessionSummary:
    fields = {"profile": "nuscenes", "state": "running", "rate_hz": 10.0, "latency_p50_ms": 2.0, "latency_p99_ms": 5.0}
    return SessionSummary(stream=stream, frames=100, tracks=7, age_s=0.1, **fields | changes)


def service(instance: str = "one", *sessions: SessionSummary, **changes: Any) -> ServiceStatus:
    fields = {"version": "1", "started_ns": 1, "uptime_s": 60.0, "state": "ready"}
    return ServiceStatus(instance=instance, sessions=sessions, **fields | changes)


def text(view: StatusView, height: int = HEIGHT, width: int = 140) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(view.render(height, width))
    return console.export_text()


def test_rates_are_those_of_the_last_interval() -> None:
    """Frames and losses per second are differences of counters, not means since the start."""
    view = StatusView("here")
    view.take([service("one", session("a/b/c", shed=50), frames=5000)], 10.0)
    view.take([service("one", session("a/b/c", shed=54), frames=5040)], 12.0)
    title = text(view).splitlines()[0]
    assert "1 service, 1 stream, 20 frames/s, 2.0 lost/s" in title


def test_a_restart_is_no_negative_rate() -> None:
    """Counters that begin again after a restart are not compared with those before it."""
    view = StatusView("here")
    view.take([service("one", session("a/b/c"), frames=5000)], 10.0)
    view.take([service("one", session("a/b/c", shed=9), frames=5000)], 10.5)
    view.take([service("one", session("a/b/c"), frames=3, started_ns=2)], 11.0)
    assert "0 frames/s, 0.0 lost/s" in text(view)
    (line,) = [line for line in text(view).splitlines() if line.startswith("a/b/c")]
    assert line.split()[8] == "0.0"


def test_the_worst_come_first_and_the_rest_is_counted() -> None:
    """With more streams than lines, streams that lose frames come first, then the silent, then the late."""
    well = [session(f"a/b/well-{number:02}") for number in range(50)]
    late, silent = session("z/z/late", latency_p99_ms=300.0), session("z/z/silent", state="stale")
    view = StatusView("here")
    view.take([service("one", *well, late, silent, session("z/z/losing", shed=1))], 1.0)
    view.take([service("one", *well, late, silent, session("z/z/losing", shed=9))], 2.0)
    lines = text(view, 20).splitlines()
    assert len(lines) <= 20
    streams = [line.split()[0] for line in lines if "/" in line.split(" ")[0]]
    assert streams[:4] == ["z/z/losing", "z/z/silent", "z/z/late", "a/b/well-00"]
    assert f"and {53 - len(streams)} more in better state" in text(view, 20)


def test_an_instance_that_vanished_is_shown_for_a_while() -> None:
    """It is marked as gone for a minute, then forgotten; the others go on."""
    view = StatusView("here")
    view.take([service("one", session("a/b/c")), service("two")], 1.0)
    view.take([service("two", session("a/b/c"))], 21.0)
    (line,) = [line for line in text(view).splitlines() if line.startswith("one")]
    assert "gone for 20.0 s" in line
    view.take([service("two")], 90.0)
    assert "one" not in [line.split(" ")[0] for line in text(view).splitlines()]


def test_problems_are_shown_once_with_their_age() -> None:
    """A problem that every sample repeats is one line, which says how long ago it came."""
    problem = Problem(stream="a/b/c", instance="one", code="late", message="Frame 7: late.", count=3)
    view = StatusView("here")
    for second in range(5):
        view.take([service("one", session("a/b/c"), problems=(problem,))], float(second))
    lines = [line for line in text(view).splitlines() if "Frame 7" in line]
    assert len(lines) == 1
    assert lines[0].split()[:4] == ["4.0", "s", "ago", "a/b/c:"]
    assert "(3 times)" in lines[0]


def test_problems_are_as_old_as_the_service_says() -> None:
    """Also those from before the view began, and where a service has more of them than the view holds."""
    reported = [
        Problem(stream="a/b/c", instance="one", code="late", message=f"Frame {n}.", reported_ns=n * SECOND)
        for n in range(100)
    ]
    view = StatusView("here")
    for second in range(3):
        status = service("one", session("a/b/c"), problems=tuple(reported), started_ns=0, uptime_s=7300.0 + second)
        view.take([status], float(second))
    lines = [line.split() for line in text(view).splitlines() if "Frame" in line]
    assert [line[-1] for line in lines] == [f"{n}." for n in range(94, 100)]
    assert {" ".join(line[:3]) for line in lines} == {"2 h ago"}


@pytest.mark.parametrize("width", [80, 140])
def test_a_narrow_terminal_shows_fewer_columns(width: int) -> None:
    """Names and what says that something is wrong are whole at any width; what matters less needs a wide terminal."""
    view = StatusView("tcp/127.0.0.1:7447")
    for second in range(60):
        view.take([service("edge-1", session("garage/robot-1/lidar-front"), state="degraded")], float(second))
    lines = text(view, width=width).splitlines()
    assert max(map(len, lines)) <= width
    assert not any("…" in line for line in lines)
    for word in ("edge-1", "degraded", "garage/robot-1/lidar-front", "running", "p99 ms", "lost/s"):
        assert any(word in line for line in lines)
    assert any("nuscenes" in line for line in lines) == (width > 80)


def test_long_names_fit_80_columns() -> None:
    """The view and the tables show the end of a long name, with the message of a problem."""
    name = "plant-north-hall-3/forklift-0012/lidar-front-left"
    problem = Problem(
        stream=name, instance="one", code="restarted", received="publisher, +24.064 s", message="the publisher is new"
    )
    status = service("one", session(name), problems=(problem,))
    view = StatusView("tcp/127.0.0.1:7447")
    view.take([status], 1.0)
    console = Console(width=80, record=True, file=io.StringIO())
    for part in status_tables([status]).renderables:
        for table in parts(part, 80) if isinstance(part, Table) else (part,):
            console.print(table)
    for shown in (text(view, width=80), console.export_text()):
        assert max(map(len, shown.splitlines())) <= 80
        assert "lidar-front-left" in shown.replace("\n", "") or "-left" in shown
        assert "the publisher is new" in shown.replace("\n", " ")
        assert "running" in shown


def test_nothing_there_is_said() -> None:
    """Without any service the view says so."""
    view = StatusView("here")
    view.take([], 1.0)
    assert "no service answers" in text(view)
