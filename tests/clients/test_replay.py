"""Replaying through a stand-in for the service: pace, order, missing frames, errors, and leftovers."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from fake_service import Behaviour, FakeService
from optipmb_client import Connection, ServiceRefused
from optipmb_schemas import Detections, Tracks
from optipmb_tools.datasets import Dataset, open_dataset
from optipmb_tools.run.replay import ReplayedSequence, Replaying, ReplayPace, replay
from router import until

FRAMES = 24
QUICK = ReplayPace(patience_s=60.0, service_s=60.0)


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return open_dataset("scene", frames=FRAMES, vehicles=6, pedestrians=2, cyclists=1)


@pytest.fixture
def link(endpoint: str) -> Iterator[Connection]:
    with Connection(endpoint) as connection:
        yield connection


def run(
    link: Connection,
    dataset: Dataset,
    out: Path,
    *names: str,
    on_frame: Callable[[], None] = lambda: None,
    **options: object,
) -> list[ReplayedSequence]:
    how = replace(Replaying("kitti", QUICK), **options)  # type: ignore[arg-type]  # given by the tests
    return replay(link, dataset, dataset.sequences(names or ["0000"]), out, how, on_frame)


def test_every_frame_comes_back(endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path) -> None:
    """All frames are sent, with their clouds, and returned, with a latency each; the file has a row per detection."""
    with FakeService(endpoint) as service:
        (result,) = run(link, dataset, tmp_path)
    assert (result.frames, result.sent, result.returned, result.missing) == (FRAMES, FRAMES, FRAMES, 0)
    assert result.latency is not None
    assert 0.0 < result.latency.p50_ms <= result.latency.p99_ms <= result.latency.max_ms
    assert len(result.latencies_ns) == FRAMES
    assert result.clouds == FRAMES
    assert {message.has_points for message in service.seen.detections} == {True}
    assert [message.stamp_ns for message in service.seen.points] == [m.stamp_ns for m in service.seen.detections]
    assert result.file == tmp_path / "0000.txt"
    rows = sum(len(message.label) for message in service.seen.detections)
    assert len(result.file.read_text().splitlines()) == rows > FRAMES


def test_parameters_come_first_and_the_session_is_closed(
    endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path
) -> None:
    """The profile and a generous wait for clouds are set before the first frame; at the end the session is closed."""
    with FakeService(endpoint) as service:
        (result,) = run(link, dataset, tmp_path, profile="nuscenes")
    ((stream, parameters),) = service.seen.parameters
    assert stream == result.stream
    assert parameters.profile == "nuscenes"
    assert parameters.cloud_wait_s is not None
    assert parameters.cloud_wait_s >= 5.0
    assert service.seen.closed == [result.stream]


def test_streams_are_new_in_every_run(endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path) -> None:
    """Two runs of the same sequence use different streams, `replay/<dataset>-<6 hex>/<sequence>`."""
    with FakeService(endpoint):
        names = [run(link, dataset, tmp_path)[0].stream for _ in range(2)]
    for name in names:
        site, node, sensor = name.split("/")
        assert (site, node[:6], sensor) == ("replay", "scene-", "0000")
        assert int(node[6:], 16) < 16**6
    assert names[0] != names[1]


def test_frames_without_clouds_say_that_none_comes(endpoint: str, link: Connection, tmp_path: Path) -> None:
    """Without clouds no frame leaves the question open, so that the service never waits."""
    bare = open_dataset("scene", frames=FRAMES, vehicles=3, clouds=False)
    with FakeService(endpoint) as service:
        (result,) = run(link, bare, tmp_path)
    assert (result.clouds, result.missing) == (0, 0)
    assert {message.has_points for message in service.seen.detections} == {False}


@pytest.mark.parametrize(
    ("pace", "seq", "most"),
    [(ReplayPace(window=4, patience_s=60.0), 0, 4), (ReplayPace(speed=1.0, patience_s=60.0), 2, 6)],
)
def test_frames_sent_ahead_are_bounded(
    endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path, pace: ReplayPace, seq: int, most: int
) -> None:
    """Without tracks, at full speed a window of frames is sent ahead, at the recorded rate four frames with clouds.

    So the cache holds the clouds of all of them.
    """
    gate, ahead = threading.Event(), list[int]()

    def sent() -> int:
        """By the newest cloud: on a busy machine the first may be sent before the subscription is known."""
        return max((cloud.seq for cloud in service.seen.points), default=-1) + 1

    def answer(message: Detections, tracks: Tracks) -> list[Tracks]:
        if message.seq == seq:
            until(lambda: sent() >= most, "the frames gather behind the first without tracks")
            gate.wait(0.5)  # further ones would be due: a wait that is never answered, on purpose
            ahead.append(sent())
        return [tracks]

    with FakeService(endpoint, Behaviour(answer)) as service:
        (result,) = run(link, dataset, tmp_path, pace=pace)
    assert (ahead, result.missing) == ([most], 0)


def test_recorded_pace_is_kept(endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path) -> None:
    """At twice the recorded rate, n frames of 0.1 s take (n - 1) / 20 s, whether or not tracks are slow."""
    with FakeService(endpoint) as service:
        begun = time.monotonic()
        (result,) = run(link, dataset, tmp_path, pace=ReplayPace(speed=2.0, patience_s=60.0))
        took = time.monotonic() - begun
    assert result.missing == 0
    assert took >= 0.05 * (FRAMES - 1)
    assert len(service.seen.detections) == FRAMES


def test_lost_tracks_are_reported_as_missing(endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path) -> None:
    """Frames whose tracks never come are counted, the others are written; the replay does not wait for patience."""
    lost = {3, 4, FRAMES - 2}

    def answer(message: Detections, tracks: Tracks) -> list[Tracks]:
        return [] if message.seq in lost else [tracks]

    with FakeService(endpoint, Behaviour(answer)):
        (result,) = run(link, dataset, tmp_path, pace=ReplayPace(patience_s=1e6))
    assert (result.sent, result.returned, result.missing) == (FRAMES, FRAMES - 3, 3)
    frames = {int(line.split()[0]) for line in result.file.read_text().splitlines()}
    assert frames.isdisjoint(lost)
    assert {0, 5, FRAMES - 1} <= frames


def test_a_service_that_falls_silent_ends_the_replay(
    endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path
) -> None:
    """When nothing comes back for `patience_s`, the replay ends and reports all that is missing."""

    def answer(message: Detections, tracks: Tracks) -> list[Tracks]:
        return [tracks] if message.seq < 5 else []

    with FakeService(endpoint, Behaviour(answer)):
        (result,) = run(link, dataset, tmp_path, pace=ReplayPace(patience_s=6.0))
    assert (result.returned, result.missing) == (5, FRAMES - 5)
    assert result.sent == 5 + 8


def test_the_newest_revision_is_written(endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path) -> None:
    """Of several revisions of a frame, in any order, the highest is in the file."""

    def answer(message: Detections, tracks: Tracks) -> list[Tracks]:
        changed = tracks.model_copy(update={"revision": 1, "id": tracks.id + 1000})
        again = tracks.model_copy(update={"revision": 2, "id": tracks.id + 2000})
        return [tracks, again, changed] if message.seq == 7 else [tracks]

    with FakeService(endpoint, Behaviour(answer)):
        (result,) = run(link, dataset, tmp_path)
    rows = [line.split() for line in result.file.read_text().splitlines()]
    assert {int(row[1]) >= 2000 for row in rows if row[0] == "7"} == {True}
    assert {int(row[1]) < 1000 for row in rows if row[0] != "7"} == {True}


def test_a_service_that_comes_late_is_waited_for(
    endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path
) -> None:
    """A replay started just before its service goes through."""
    results: list[ReplayedSequence] = []
    thread = threading.Thread(
        target=lambda: results.extend(run(link, dataset, tmp_path, pace=ReplayPace(service_s=20.0))), daemon=True
    )
    thread.start()
    with FakeService(endpoint):
        thread.join(30.0)
    assert [result.missing for result in results] == [0]


def test_a_refused_profile_is_told_in_the_words_of_the_service(
    endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path
) -> None:
    """The service's error reply becomes ServiceRefused with its sentence."""
    with FakeService(endpoint), pytest.raises(ServiceRefused, match="received 'waymo'"):
        run(link, dataset, tmp_path, profile="waymo")


def test_an_interrupt_says_what_is_complete(
    endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first sequence is written, the second is not, and the error says so."""
    written: list[object] = []

    def interrupted(*_: object) -> tuple[set[object], set[object]]:
        until(lambda: bool(written), "a frame of the second")
        raise KeyboardInterrupt

    def slow() -> None:
        if list(tmp_path.iterdir()):
            written.append(1)

    monkeypatch.setattr("concurrent.futures.wait", interrupted)
    with FakeService(endpoint), pytest.raises(KeyboardInterrupt, match=f"1 of 2 recordings are in {tmp_path}"):
        run(link, dataset, tmp_path, "0000", "0001", streams=1, on_frame=slow)
    assert [path.name for path in tmp_path.glob("*.txt")] == ["0000.txt"]


@pytest.mark.timeout(60)
def test_an_interrupt_ends_the_wait_for_a_service(
    link: Connection, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no service answers, a replay that would wait for an hour ends when it is interrupted."""
    asked = threading.Event()

    def unanswered(*_: object, **__: object) -> list[object]:
        asked.set()
        return []

    def interrupted(*_: object) -> None:
        assert asked.wait(30)
        raise KeyboardInterrupt

    monkeypatch.setattr(link, "query", unanswered)
    monkeypatch.setattr("concurrent.futures.wait", interrupted)
    with pytest.raises(KeyboardInterrupt, match="0 of 1 recordings"):
        run(link, dataset, tmp_path, pace=replace(QUICK, service_s=3600.0))


def test_one_failing_sequence_ends_the_others_and_closes_their_sessions(
    endpoint: str, link: Connection, dataset: Dataset, tmp_path: Path
) -> None:
    """An error anywhere, here in the display of progress, ends all sequences and closes their sessions."""
    count = [0]

    def broken() -> None:
        count[0] += 1
        if count[0] > 6:
            raise RuntimeError("display")

    with FakeService(endpoint) as service, pytest.raises(RuntimeError, match="display"):
        run(link, dataset, tmp_path, "0000", "0001", streams=2, on_frame=broken)
    assert len(service.seen.closed) == len({stream for stream, _ in service.seen.parameters})
    assert list(tmp_path.iterdir()) == []
