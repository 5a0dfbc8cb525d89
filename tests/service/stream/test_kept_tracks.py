"""Tracks that are asked for later: a range of stamps, each frame once, in bounded answers."""

import json
import queue
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import pytest
import zenoh
from commands import run_here
from fake_service import tracks_of
from optipmb_client import Connection, ServiceRefused, ServiceUnavailable, kept_tracks
from optipmb_schemas import Keys, Limits, Tracks, TracksRequest, decode, encode, encoding_of
from optipmb_service.streams import kept_tracks as service_tracks
from optipmb_service.streams.kept_tracks import LATE_NS, TracksRange
from optipmb_tools.table_files import read_table
from router import Node, Sensor, plain, until
from routers import free_endpoint, open_client, open_router

KEYS = Keys()
SENSOR = Sensor()


class Message(NamedTuple):
    seq: int
    order: tuple[int, int] = (1, 0)
    stamp_ns: int = 0
    payload: bytes = bytes(10)
    epoch: bytes = b"e"
    sensor: str = ""
    encoding: str = ""


def at(*seqs: int, **fields: Any) -> list[Message]:
    return [Message(seq=seq, stamp_ns=seq * 10**9, **fields) for seq in seqs]


def seqs(messages: Iterable[Any]) -> list[int]:
    return [one.seq for one in messages]


def test_of_a_frame_the_tracks_that_hold_are_taken() -> None:
    """The latest run, in it the latest revision, for any order of arrival; another sensor's frame is another one."""
    found = TracksRange(0, None)
    first, corrected, later_run = (at(1, order=order)[0] for order in ((1, 0), (1, 3), (2, 0)))
    found.add([first, later_run, corrected, *at(1, sensor="a/b/c")])
    assert [(one.order, one.sensor) for one in found.messages()] == [((2, 0), ""), ((1, 0), "a/b/c")]


def test_a_correction_after_the_range_counts() -> None:
    """Reading goes on behind the last stamp for as long as a frame of the range may be corrected there."""
    found = TracksRange(0, 10**9)
    assert found.add(at(0, 1, 2))
    assert found.add(at(1, order=(1, 1)))
    assert not found.add([Message(9, stamp_ns=10**9 + LATE_NS + 1)])
    assert [one.order for one in found.messages()] == [(1, 0), (1, 1)]


@pytest.mark.parametrize("bounds", [{"most": 3}, {"most_bytes": 30}])
def test_an_answer_is_bounded_and_says_where_the_rest_begins(bounds: dict[str, int]) -> None:
    """Parts that continue at the last cut have all frames once, for any size of a part."""
    parts, next_ns = [], 0
    while next_ns is not None:
        found = TracksRange(next_ns, None, **bounds)
        for seq in range(10):
            found.add(at(seq))
        parts.append(seqs(found.messages()))
        next_ns = found.cut_ns
    assert parts == [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9]]


def test_frames_of_one_stamp_stay_together() -> None:
    """However many there are: an answer always goes on by one stamp at least."""
    found = TracksRange(0, None, most=2)
    found.add([Message(seq) for seq in range(5)] + at(7))
    assert (seqs(found.messages()), found.cut_ns) == ([0, 1, 2, 3, 4], 7 * 10**9)


def test_the_newest_tracks_are_there_without_a_log(node: Node) -> None:
    """They are the published messages, byte for byte; an expired range, and another stream, gives none."""
    node.send(*(SENSOR.detections(seq) for seq in range(10)))
    published = {one.seq: plain(one) for one in node.tracks(SENSOR.stream, 10)}
    key = KEYS.query(SENSOR.stream, "tracks")

    def asked(request: TracksRequest | None = None) -> dict[int, bytes]:
        answers = node.query(key, request)
        assert all(ok for ok, _, _ in answers)
        assert decode(answers[-1][2], TracksRequest) == (request or TracksRequest())
        return {one.seq: plain(one) for one in (decode(payload, Tracks) for _, _, payload in answers[:-1])}

    until(lambda: asked() == published, "all are kept")
    some = TracksRequest(from_ns=SENSOR.stamp_ns(3), to_ns=SENSOR.stamp_ns(6))
    assert asked(some) == {seq: published[seq] for seq in range(3, 7)}
    assert asked(TracksRequest(from_ns=SENSOR.stamp_ns(10))) == {}
    ((_, _, end),) = node.query(KEYS.query("site/node/nobody", "tracks"))
    assert decode(end, TracksRequest) == TracksRequest()


def test_a_range_that_ends_before_it_begins_is_refused(node: Node) -> None:
    """With the field, also to the client."""
    node.send(SENSOR.detections(0))
    node.tracks(SENSOR.stream, 1)
    problem = node.refused(KEYS.query(SENSOR.stream, "tracks"), TracksRequest(from_ns=5, to_ns=4))
    assert (problem.code, problem.path) == ("invalid_value", "to_ns")
    assert node.refused(KEYS.query(SENSOR.stream, "tracks"), b"\xc1").code == "malformed"


@pytest.mark.parametrize("payload", [encode(TracksRequest()), b""])
def test_an_answer_that_breaks_off_is_an_error(payload: bytes) -> None:
    """Without the last reply the tracks are incomplete, and the reader learns it."""
    key = KEYS.query(SENSOR.stream, "tracks")
    endpoint, example = free_endpoint(), encode(tracks_of(SENSOR.detections(0)))

    def answer(query: zenoh.Query) -> None:
        query.reply(key, example, encoding=encoding_of(Tracks))
        if payload:
            query.reply(key, payload, encoding=encoding_of(TracksRequest))

    with open_router(endpoint), open_client(endpoint) as service, Connection(endpoint) as connection:
        service.declare_queryable(key, answer)
        until(lambda: connection.query(key), "the service answers")
        if payload:
            assert len(list(kept_tracks(connection, SENSOR.stream))) == 1
        else:
            with pytest.raises(ServiceUnavailable, match="did not come completely"):
                list(kept_tracks(connection, SENSOR.stream))


def test_a_search_that_fails_takes_no_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """A query that fails by an unforeseen error is answered, and so is the next."""
    monkeypatch.setattr(service_tracks, "AT_ONCE", 1)
    kept, refused = Mock(), queue.SimpleQueue[Any]()
    kept.tracks.side_effect = ValueError("a mistake")
    query = service_tracks.TrackQuery(kept, Mock(), "test", Limits())
    for _ in range(service_tracks.AT_ONCE + 1):
        query.answer(Mock(payload=b"", refuse=refused.put), SENSOR.stream)
        problem = refused.get(timeout=60.0)
        assert (problem.code, problem.received) == ("message_log", "ValueError: a mistake")


def test_the_client_asks_part_by_part(
    start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`kept_tracks` and `optipmb tracks` give all frames of a range, however few an answer takes."""
    monkeypatch.setattr(service_tracks, "TracksRange", partial(TracksRange, most=3))
    _, endpoint = start()
    with Node(endpoint) as node, Connection(endpoint) as connection:
        node.send(*(SENSOR.detections(seq) for seq in range(10)))
        published = [plain(one) for one in node.tracks(SENSOR.stream, 10)]

        def found(*stamps: int) -> list[bytes]:
            return [plain(one) for one in kept_tracks(connection, SENSOR.stream, *stamps)]

        until(lambda: found() == published, "all are kept")
        assert found(SENSOR.stamp_ns(1), SENSOR.stamp_ns(8)) == published[1:9]
        with pytest.raises(ServiceRefused, match="to_ns"):
            found(5, 4)
        with pytest.raises(ServiceUnavailable):
            list(kept_tracks(connection, SENSOR.stream, prefix="other"))
        asked = ("tracks", SENSOR.stream, "--connect", endpoint)
        table = tmp_path / "tracks.csv"
        shown = run_here(capsys, *asked, "--last", "0.45", "--out", table, "--json").stdout
        # Logs of the service, which is in this process, go the same way.
        result = json.loads(next(line for line in shown.splitlines() if line.startswith("{")))
        assert (result["frames"], result["stamps_ns"]) == (5, [SENSOR.stamp_ns(5), SENSOR.stamp_ns(9)])
        assert set(read_table(table)["stamp_ns"]) == {SENSOR.stamp_ns(seq) for seq in range(5, 10)}
        assert "10 frames" in run_here(capsys, *asked).stdout
        assert run_here(capsys, *asked, "--last", "1", "--to", "3").returncode == 2
        assert run_here(capsys, *asked, "--out", tmp_path / "tracks.png").returncode == 2
