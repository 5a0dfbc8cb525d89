"""Queries that come faster than they are answered."""

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

import optipmb_service.zenoh.transport
import pytest
from optipmb_schemas import Keys, Problem, SessionState, decode
from optipmb_service.settings import Settings
from optipmb_service.streams import queries
from optipmb_service.streams.queries import ServiceQueries, StreamQueries
from optipmb_service.zenoh.topics import Packet
from optipmb_service.zenoh.transport import Transport
from registries import Around, packet_of, streams_of
from router import Node, Sensor, until
from routers import free_endpoint, open_router

KEYS: Final = Keys()
SENSOR: Final = Sensor()
ASK_S: Final = 60.0
MOST: Final = 4
ASKED: Final = 10


def test_a_query_about_many_streams_whose_state_fails_gives_its_room_back(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of more queries than may be open ends without an answer, and the next one is answered."""
    _, endpoint = start()
    key = f"{KEYS.prefix}/*/*/*/q/state"
    with Node(endpoint) as node:
        node.send(SENSOR.detections(0))
        node.tracks(SENSOR.stream, 1)
        with monkeypatch.context() as broken:
            broken.setattr(StreamQueries, "_state", lambda *_: 1 / 0)
            assert [node.query(key, None, ASK_S) for _ in range(2 * queries.MOST_WILDCARDS)] == [
                []
            ] * 2 * queries.MOST_WILDCARDS
        assert [ok for ok, _, _ in node.query(key, None, ASK_S)] == [True]


@pytest.mark.parametrize(
    ("module", "name", "key"),
    [
        (optipmb_service.zenoh.transport, "MOST_OPEN", KEYS.query(SENSOR.stream, "state")),
        (queries, "MOST_WILDCARDS", f"{KEYS.prefix}/*/*/*/q/state"),
    ],
    ids=["of one stream", "of many"],
)
def test_queries_beyond_those_that_may_be_open_are_refused(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, module: Any, name: str, key: str
) -> None:
    """Answers take a while: as many queries as may be open wait, others are refused at once, frames are tracked."""
    gate, digest = threading.Event(), queries.digest_of

    def slow(checkpoint: Any) -> str:
        assert gate.wait(ASK_S)
        return digest(checkpoint)

    monkeypatch.setattr(queries, "digest_of", slow)
    monkeypatch.setattr(module, name, MOST)
    _, endpoint = start()
    with Node(endpoint) as node, ThreadPoolExecutor(ASKED) as asking:
        node.send(SENSOR.detections(0))
        node.tracks(SENSOR.stream, 1)
        asked = [asking.submit(node.query, key, None, ASK_S) for _ in range(ASKED)]
        until(lambda: sum(one.done() for one in asked) == ASKED - MOST, "the refusals")
        node.send(SENSOR.detections(1))
        node.tracks(SENSOR.stream, 2)
        gate.set()
        answers = [answer for one in asked for answer in one.result(60)]
        refused = [decode(payload, Problem) for ok, _, payload in answers if not ok]
        answered = [decode(payload, SessionState) for ok, _, payload in answers if ok]
        assert (len(refused), len(answered)) == (ASKED - MOST, MOST)
        assert {(one.code, str(MOST) in one.expected) for one in refused} == {("refused", True)}
        for _ in range(2 * MOST):  # each gives its room back
            assert [ok for ok, _, _ in node.query(key, None, ASK_S)] == [True]


@pytest.mark.parametrize("parent", ["", "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"])
def test_messages_that_move_to_another_member_keep_their_trace_context(parent: str) -> None:
    """They come with the key under which they were published, and with the context, where they have one."""
    packet, endpoint = packet_of(SENSOR.detections(0)), free_endpoint()
    nothing: Any = None
    packet.traceparent = parent
    member = ServiceQueries(
        streams_of(Around()), status=nothing, metrics=nothing, hand_over=lambda _, give: give(packet), workers=1
    )
    with open_router(endpoint), contextlib.ExitStack() as closing:
        there, here = (Transport(Settings(instance=name, connect=[endpoint], store="none")) for name in ("b", "a"))
        closing.callback(there.close)
        closing.callback(here.close)
        there.serve_service(member.answer)
        found: list[Packet] = []
        until(lambda: found.extend(here.ask_recent([SENSOR.stream])) or found, "the messages")
    assert [(one.key, one.payload, one.traceparent) for one in found] == [(packet.key, packet.payload, parent)]
