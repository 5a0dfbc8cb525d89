"""What runs: services found by their liveliness, shown as a table or as JSON."""

import contextlib
import json
import time
from collections.abc import Callable
from typing import Any

import pytest
from fake_service import Behaviour, FakeService
from optipmb_client import Connection
from optipmb_client.sessions import find_services
from optipmb_schemas import Keys, MemberSummary, Problem, ServiceStatus, SessionSummary, encoding_of
from optipmb_tools.cli import run
from optipmb_tools.views.terminal import members_of, status_tables
from rich.console import Console
from routers import open_client


def test_a_service_is_shown_with_its_streams_and_problems(
    endpoint: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table holds instance, uptime, each stream with its figures, and the newest problem."""
    monkeypatch.setenv("COLUMNS", "200")  # a narrow terminal folds the lines
    with FakeService(endpoint):
        assert run(["status", "--connect", endpoint, "--timeout", "10"]) == 0
    text = capsys.readouterr().out
    head, columns, stream, problem = text.splitlines()
    assert head.split()[:2] == ["fake", "ready,"]
    assert "1.2.3" in head
    assert "2 h" in head
    assert columns.split()[0] == "stream"
    assert stream.split()[:4] == ["a/b/c", "kitti", "running", "10.0"]
    assert "1234" in stream
    assert "score[3]: too high" in problem


def test_json_holds_the_messages(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    """--json prints the status messages as they are."""
    with FakeService(endpoint):
        assert run(["status", "--connect", endpoint, "--timeout", "10", "--json"]) == 0
    (service,) = json.loads(capsys.readouterr().out)["services"]
    assert service["instance"] == "fake"
    assert service["sessions"][0]["frames"] == 1234


def test_members_are_told_by_their_own_instance() -> None:
    """A member's own report decides its age, also among workers of an instance with a common name prefix."""

    def member(name: str, age_s: float) -> MemberSummary:
        return MemberSummary(member=name, state="alive", age_s=age_s, partitions=(), fences=())

    def service(instance: str, age_s: float) -> ServiceStatus:
        """The status of an instance that heard of both so long ago."""
        heard = (member("a-w1/0", age_s), member("a-west/0", age_s))
        return ServiceStatus(instance=instance, version="1", started_ns=0, uptime_s=1.0, state="ready", members=heard)

    told = {one.member: one.age_s for one in members_of([service("a", 2.0), service("a-west", 3.0), service("b", 1.0)])}
    assert told == {"a-w1/0": 2.0, "a-west/0": 3.0}


def test_every_service_is_found(endpoint: str) -> None:
    """Two services on one network are both listed, by instance; one that ended is not."""
    with Connection(endpoint) as connection, FakeService(endpoint, instance="one"):
        with FakeService(endpoint, instance="two"):
            deadline = time.monotonic() + 60.0
            while len(found := find_services(connection)) < 2 and time.monotonic() < deadline:
                pass
            assert [status.instance for status in found] == ["one", "two"]
        while len(found := find_services(connection)) > 1 and time.monotonic() < deadline:
            pass
        assert [status.instance for status in found] == ["one"]


@pytest.mark.parametrize(
    "answer",
    [
        lambda _: None,
        lambda query: query.reply_err(b"too many queries"),
        lambda query: query.reply(query.key_expr, b"of another release", encoding=encoding_of(ServiceStatus)),
    ],
)
def test_a_service_that_does_not_answer_is_named(
    answer: Callable[[Any], None], endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """It has a liveliness token and no good answer, as one that is overloaded; others are shown all the same."""
    with contextlib.closing(open_client(endpoint)) as session, FakeService(endpoint):
        session.declare_queryable(Keys().status("slow"), answer)
        token = session.liveliness().declare_token(Keys().alive("slow"))
        deadline = time.monotonic() + 60.0
        with Connection(endpoint) as connection:
            while len(connection.alive(Keys().all_alive())) < 2 and time.monotonic() < deadline:
                pass
        assert run(["status", "--connect", endpoint, "--timeout", "1"]) == 0  # the router answers within it
        token.undeclare()
    shown = capsys.readouterr()
    assert "slow is alive and does not answer" in shown.err
    assert shown.out.startswith("fake")


def test_a_drain_is_awaited(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb drain` asks until the others have all streams and says how many are left; --wait bounds it."""
    for wait, status, asked in (("60", 0, 3), ("0", 1, 1)):
        with FakeService(endpoint, Behaviour(slow_drains=2)) as service:
            assert run(["drain", "fake", "--connect", endpoint, "--wait", wait]) == status
            assert service.seen.drains == asked
        shown = capsys.readouterr()
        assert shown.out == ("" if status else "fake holds no streams\n")
        assert shown.err.count("still holds streams: 1") == asked - 1
        assert ("not all taken in time" in shown.err) == bool(status)


def test_nobody_is_an_empty_list_after_the_patience(endpoint: str) -> None:
    """Without a service the search ends when its time is up."""
    with Connection(endpoint) as connection:
        begun = time.monotonic()
        assert find_services(connection, patience_s=0.3) == []
        assert time.monotonic() - begun >= 0.3


def test_text_from_the_network_is_never_markup() -> None:
    """A problem's text with brackets is shown as it is."""
    text = "[red]x[/red] [/] received '[bold]'"
    problem = Problem(stream="a/b/c", instance="x", code="malformed", message=text, count=3)
    status = ServiceStatus(instance="x", version="1", started_ns=0, uptime_s=1.0, state="ready", problems=(problem,))
    console = Console(width=200)
    with console.capture() as capture:
        console.print(status_tables([status]))
    assert f"{text} (3 times)" in capture.get()


def test_joining_is_told_where_it_happens() -> None:
    """A stream that joins tracks has a line with what was joined, lost and ignored; another has none."""
    sessions = tuple(
        SessionSummary(stream=f"a/b/{name}", profile="generic", state="running", **counts)
        for name, counts in (("c", {"rejoined": 3, "lost_objects": 2, "embedding_ignored": 7}), ("d", {}))
    )
    status = ServiceStatus(instance="x", version="1", started_ns=0, uptime_s=1.0, state="ready", sessions=sessions)
    console = Console(width=200)
    with console.capture() as capture:
        console.print(status_tables([status]))
    lines = [line.strip() for line in capture.get().splitlines() if "joined" in line]
    assert lines == ["a/b/c: 3 tracks joined over gaps, 2 lost objects, 7 frames with ignored embeddings"]
