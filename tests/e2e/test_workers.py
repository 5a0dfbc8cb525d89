"""A service of several worker processes: one instance to the network, and none of them is missed for long."""

import os
import signal
from collections.abc import Callable, Iterator

import pytest
from commands import run_here
from optipmb_schemas import Keys, MoveRequest, ServiceStatus, Tracks, decode
from processes import descendants, wait_until_ended
from router import Node, Sensor, plain, until
from service_process import ServiceProcess
from takeovers import expected

KEYS = Keys()
STREAMS = [f"yard/node-{number}/lidar" for number in range(6)]
FRAMES = 12
DEADLINE_S = 60.0
OPTIONS = ("--workers", "2", "--instance", "pair")


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """A service of two workers, which must end in order when the tests are done: all processes, status 0, in time."""
    store = {"OPTIPMB_STORE": str(tmp_path_factory.mktemp("store"))}
    with ServiceProcess(*OPTIONS, environment=store) as process:
        assert process.wait_ready() == f"ready instance=pair endpoints={process.endpoint}"
        children = descendants(process.process.pid)
        yield process
        assert len(children) == 2
        status, _ = process.end(signal.SIGTERM)
        assert wait_until_ended(children, 0.0) == set()
        assert (status, process.output) == (0, [])
        assert process.errors.count("worker_killed") == process.errors.count("worker_stuck")


def status_when(node: Node, reached: Callable[[ServiceStatus], bool], instance: str = "pair") -> ServiceStatus:
    asked: list[ServiceStatus] = []

    def is_reached() -> bool:
        asked.append(node.ask(KEYS.status(instance), ServiceStatus))
        return reached(asked[-1])

    until(is_reached, "the status is as wanted")
    return asked[-1]


def arrived(node: Node, stream: str, seq: int) -> None:
    key = KEYS.tracks(stream)
    node.tracks_seen.wait(
        lambda items: any(at == key and decode(payload, Tracks).seq == seq for at, payload, _ in items),
        f"tracks of frame {seq} of {stream}",
    )


def workers_of(status: ServiceStatus) -> dict[str, int | None]:
    """Which worker has which stream."""
    return {session.stream: session.worker for session in status.sessions}


def pid_of(service: ServiceProcess, worker: int) -> int:
    """The newest process of a worker, by the log."""
    line = [line for line in service.errors.splitlines() if "worker_started" in line and f"worker={worker}" in line][-1]
    return int(line.partition("pid=")[2].split()[0])


def metrics(node: Node) -> tuple[dict[str, float], list[str]]:
    """The values of the metrics, which other tests count up too, and all lines."""
    lines = node.query(KEYS.metrics("pair"))[0][2].decode().splitlines()
    return {key: float(value) for key, _, value in (one.rpartition(" ") for one in lines if one[:1] != "#")}, lines


def test_workers_share_the_streams(service: ServiceProcess) -> None:
    """Every stream is tracked by one worker, with the bytes that one process would give.

    The instance has one token, and its status all streams.
    """
    sensors = [Sensor(stream=stream) for stream in STREAMS]
    with Node(service.endpoint) as node:
        before, _ = metrics(node)
        for number, stream in enumerate(STREAMS):
            node.move("pair", stream, number % 2)  # else the worker that begins later may take them while they come
        for seq in range(FRAMES):
            node.send(*(sensor.detections(seq) for sensor in sensors))
        for sensor in sensors:
            found = [plain(message) for message in node.tracks(sensor.stream, FRAMES)]
            assert found == expected(FRAMES, sensor, "generic")[0]
        status = status_when(node, lambda status: {*STREAMS} <= workers_of(status).keys())
        assert status.state == "ready"
        parts = [node.ask(KEYS.status(f"pair-w{index}"), ServiceStatus) for index in range(2)]
        streams = sorted(session.stream for part in parts for session in part.sessions)
        assert [stream for stream in streams if stream in STREAMS] == STREAMS
        shares = workers_of(status)
        assert node.alive(KEYS.all_alive()) == [KEYS.alive("pair")]
        after, lines = metrics(node)
    for worker in "01":
        mine = FRAMES * sum(str(share) == worker for stream, share in shares.items() if stream in STREAMS)
        for key in (
            f'optipmb_received_total{{topic="detections",worker="{worker}"}}',
            f'optipmb_latency_seconds_bucket{{le="+Inf",worker="{worker}"}}',
        ):
            assert after[key] - before.get(key, 0.0) == mine
    assert lines.count("# TYPE optipmb_latency_seconds histogram") == 1


def one_each(node: Node, site: str) -> dict[int, Sensor]:
    """A stream of each worker that has tracked its first frame."""
    sensors = {worker: Sensor(stream=f"{site}/{worker}/lidar") for worker in range(2)}
    for worker, sensor in sensors.items():
        node.move("pair", sensor.stream, worker)
    node.send(*(sensor.detections(0) for sensor in sensors.values()))
    for sensor in sensors.values():
        node.tracks(sensor.stream, 1)
    expected = {sensor.stream: worker for worker, sensor in sensors.items()}
    status_when(node, lambda status: expected.items() <= workers_of(status).items())
    return sensors


def goes_on(node: Node, sensor: Sensor, seq: int) -> None:
    """Send a frame and wait for its tracks: the newest equal an undisturbed session."""
    node.send(sensor.detections(seq))
    arrived(node, sensor.stream, seq)
    newest = [plain(message) for message in node.tracks(sensor.stream, seq + 1) if message.seq == seq]
    assert newest[-1] == expected(seq + 1, sensor, "generic")[0][seq]


def test_the_streams_of_a_killed_worker_go_on(service: ServiceProcess) -> None:
    """After kill -9 of a worker the other has its streams at once; when it is back each has a share, to the byte."""
    with Node(service.endpoint) as node:
        sensors = one_each(node, "kill")
        first = pid_of(service, 1)
        os.kill(first, signal.SIGKILL)
        for sensor in sensors.values():
            goes_on(node, sensor, 1)
        status_when(node, lambda status: status.state == "ready")
        assert pid_of(service, 1) != first
        for sensor in sensors.values():
            goes_on(node, sensor, 2)


def test_a_stopped_worker_is_replaced(service: ServiceProcess) -> None:
    """After SIGSTOP of a worker the other has its streams, and it is killed and started again."""
    with Node(service.endpoint) as node:
        sensors = one_each(node, "stop")
        stopped = pid_of(service, 1)
        os.kill(stopped, signal.SIGSTOP)
        goes_on(node, sensors[0], 1)
        service.wait_log("worker_stuck")
        goes_on(node, sensors[1], 1)
        status_when(node, lambda status: status.state == "ready")
        assert pid_of(service, 1) != stopped


def test_a_stream_can_be_moved(service: ServiceProcess) -> None:
    """A moved stream goes on at the other worker, in the midst of its frames, with the same tracks and none missing."""
    sensor = Sensor(stream="moves/node/lidar")
    with Node(service.endpoint) as node:
        node.send(*(sensor.detections(seq) for seq in range(FRAMES)))
        status = status_when(node, lambda status: sensor.stream in workers_of(status))
        source = workers_of(status)[sensor.stream] or 0
        for number, target in enumerate((1 - source, source), 1):
            node.move("pair", sensor.stream, target)
            node.send(*(sensor.detections(seq) for seq in range(number * FRAMES, (number + 1) * FRAMES)))
            status_when(node, lambda status: workers_of(status).get(sensor.stream) == target)  # noqa: B023 - called here
        received = node.tracks(sensor.stream, 3 * FRAMES)
        assert [plain(message) for message in received] == expected(3 * FRAMES, sensor, "generic")[0]
        problem = node.refused(KEYS.move("pair"), MoveRequest(stream=sensor.stream, worker=2))
        assert (problem.path, problem.received) == ("worker", "2")


def test_the_command_moves(service: ServiceProcess, capsys: pytest.CaptureFixture[str]) -> None:
    """`optipmb move` moves, also ahead of the first frame, and says no with status 1 and one line."""
    with Node(service.endpoint) as node:
        for target in (0, 1):
            stream = f"moves/command/{target}"
            assert run_here(capsys, "move", stream, "--to", target, "--connect", service.endpoint).returncode == 0
            node.send(Sensor(stream=stream).detections(0))
            node.tracks(stream, 1)
            assert workers_of(node.ask(KEYS.status("pair"), ServiceStatus))[stream] == target
    refused = run_here(capsys, "move", stream, "--to", 7, "--connect", service.endpoint)
    assert (refused.returncode, refused.stderr.count("\n")) == (1, 1)
    assert "from 0 to 1" in refused.stderr


def test_what_cannot_start_says_so_once() -> None:
    """A profile that does not exist ends the start with status 2 and a line that names it."""
    with ServiceProcess(*OPTIONS, "--log-level", "error", "--profile", "none.toml") as service:
        assert service.wait_end(DEADLINE_S) == 2
        assert service.output == []
        assert service.errors.count("\n") == 1
        assert "none.toml" in service.errors
