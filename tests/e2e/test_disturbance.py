"""What other people's programs do to the network must not reach the tracks of a stream."""

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from commands import kill, result_of, run_here, start
from optipmb_client import Connection, Subscriber
from optipmb_client.sessions import find_services
from optipmb_schemas import Detections, Keys, Points, Problem, SessionParameters, Tracks, encoding_of
from optipmb_tools.cli import run
from routers import open_client
from service_process import ServiceProcess

SCENE = ("--dataset", "scene", "--option", "frames=40", "--option", "clouds=0")


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    out = tmp_path_factory.mktemp("expected")
    assert run([str(one) for one in ("track", *SCENE, "--out", out, "--json")]) == 0
    return (out / "0000.txt").read_bytes()


@pytest.fixture
def replay(service: ServiceProcess, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[[], Any]:
    """A function that replays the scene at twice the recorded rate, that is for two seconds."""

    def replay() -> Any:
        way = ("--speed", 2, "--connect", service.endpoint, "--out", tmp_path, "--json")
        return result_of(run_here(capsys, "replay", *SCENE, *way))

    return replay


class Disturbance:
    """Calls a function again and again in a thread, with a running number, until the end of the context."""

    def __init__(self, act: Callable[[int], None]) -> None:
        self.count = 0
        self._act = act
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        while not self._stop.wait(0.002):
            self._act(self.count)
            self.count += 1

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(120.0)
        assert not self._thread.is_alive()


@pytest.fixture
def link(service: ServiceProcess) -> Iterator[Connection]:
    with Connection(service.endpoint) as connection:
        yield connection


def test_a_client_killed_in_the_middle(
    service: ServiceProcess, link: Connection, expected: bytes, replay: Callable[[], Any], tmp_path: Path
) -> None:
    """SIGKILL of one client while another replays: the other's file equals an undisturbed run."""
    with (
        Subscriber("replay/*/0007", connection=link) as tracks,
        Subscriber("replay/*/0000", connection=link) as others,
    ):
        victim = start(
            *(
                "replay",
                *SCENE,
                "--option",
                "frames=200",
                "--option",
                "vehicles=5",
                "--sequences",
                "0007",
                "--speed",
                "1",
            ),
            *("--connect", service.endpoint, "--out", tmp_path / "victim"),
        )
        assert tracks.receive(60.0) is not None, "the victim did not start"

        def kill_in_the_middle() -> None:
            for _ in range(10):
                others.receive(60.0)
            kill(victim)

        killer = threading.Thread(target=kill_in_the_middle, daemon=True)
        killer.start()
        result = replay()
        killer.join(60.0)
    assert victim.returncode == -9
    assert result["missing"] == 0
    assert (tmp_path / "0000.txt").read_bytes() == expected
    assert not (tmp_path / "victim" / "0007.txt").exists()


def test_garbage_on_every_key(
    service: ServiceProcess, link: Connection, expected: bytes, replay: Callable[[], Any], tmp_path: Path
) -> None:
    """Bytes without meaning on all topics and queries, of this stream and of others, leave the file as it is."""
    keys = Keys()
    kinds = {"detections": Detections, "points": Points, "tracks": Tracks, "problems": Problem}
    rng = np.random.default_rng(5)
    heads = [b"", b"\xc1", b"{", b"[" * 5000, b"\x81\xa6center\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xde"]
    with open_client(service.endpoint) as session, Subscriber("replay/*/0000", connection=link) as tracks:
        streams = ["a/b/c"]

        def disturb(number: int) -> None:
            received = tracks.receive(0.0)
            if received is not None and received.tracks.stream not in streams:
                streams.append(received.tracks.stream)
            payload = heads[number % len(heads)] + rng.bytes(number % 300)
            for stream in streams:
                for topic, kind in kinds.items():
                    encoding = encoding_of(kind) if number % 3 else "zenoh/bytes"
                    session.put(keys.all(topic).replace("*/*/*", stream), payload, encoding=encoding)
                if number % 10 == 0:
                    for what in ("state", "parameters", "reset"):
                        if what != "reset" or stream == "a/b/c":  # a reset is valid without a payload
                            link.query(keys.query(stream, what), payload, encoding_of(SessionParameters), timeout=60.0)

        with Disturbance(disturb) as disturbance:
            result = replay()
    assert len(streams) == 2, "the stream itself was not disturbed"
    assert disturbance.count > 50
    assert result["missing"] == 0
    assert (tmp_path / "0000.txt").read_bytes() == expected
    (status,) = find_services(link, patience_s=60.0)
    assert status.refused > 100
    assert status.problems
