"""Health, readiness and metrics over HTTP, and the same metrics over Zenoh."""

import contextlib
import http.client
import itertools
import json
import re
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h11
import pytest
from json_senders import Edge
from optipmb_client.errors import ClientError
from optipmb_schemas import Keys, ServiceStatus
from optipmb_service.app.health_command import ask
from optipmb_service.edges.http import Server, application, server
from optipmb_service.edges.http.server import CHUNKED_SLICE, CONNECTIONS, REQUESTS, SLICE
from optipmb_service.edges.readers import BURST
from optipmb_service.settings import Settings
from optipmb_service.telemetry.metrics import NAMESPACE, SERVICE_METRICS
from prometheus_client.parser import text_string_to_metric_families
from router import Node, Sensor, until
from routers import free_endpoint, open_router
from service_process import ServiceProcess
from watched import STREAM, Watched, asked, served
from websocket import ABNF, WebSocketException, create_connection
from wsproto import WSConnection

KEYS = Keys()
SENSOR = Sensor()
END_S = 30.0
NUMBERS = itertools.count()
NOT_MADE = {http.client.NOT_FOUND, http.client.SERVICE_UNAVAILABLE}

Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def get(address: str, path: str) -> tuple[int, str]:
    host, _, port = address.rpartition(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=60)
    try:
        connection.request("GET", path)
        response = connection.getresponse()
        assert response.getheader("cache-control") == "no-store" or response.status in NOT_MADE
        return response.status, response.read().decode()
    finally:
        connection.close()


def status_for(address: str, path: str, host: str) -> int:
    name, _, port = address.rpartition(":")
    with closing(http.client.HTTPConnection(name, int(port), timeout=10)) as connection:
        connection.request("GET", path, headers={"host": host})
        return connection.getresponse().status


def address_of(service: ServiceProcess) -> str:
    service.wait_log('"event": "http"')
    return str(re.findall(r'"address": "([^"]+)"', service.errors)[0])


def samples(text: str) -> Samples:
    families = text_string_to_metric_families(text)
    return {(one.name, tuple(sorted(one.labels.items()))): one.value for family in families for one in family.samples}


def test_health_follows_the_heartbeat() -> None:
    """`/healthz` says 200 while the control loop turns and 503 when it has not for ten seconds."""
    source = Watched()
    with served(source) as address:
        assert (get(address, "/healthz")[0], ask(address, ready=False)[0]) == (200, True)
        source.age_s = 11.0
        assert (get(address, "/healthz")[0], ask(address, ready=False)[0]) == (503, False)


OWN = ("127.0.0.1:8080", "[::1]:8080", "LOCALHOST", "service-1:8080", "Tracker.Example.org:8080")
FOREIGN = ("stranger.example.org", "127.0.0.1.example.org:8080", "")


def test_a_host_that_is_not_the_service_s_is_refused() -> None:
    """A foreign host name gets no answer; addresses, plain names and names in the settings do.

    Probes and Prometheus get answers by names with a domain or a trailing dot, without a setting.
    """
    with served(Watched(), http_hosts=["tracker.example.org"]) as address:
        assert [status_for(address, "/", host) for host in OWN] == [200] * len(OWN)
        assert [status_for(address, "/", host) for host in FOREIGN] == [421] * len(FOREIGN)
        for path in ("/healthz", "/readyz", "/metrics"):
            for host in ("tracker.site.svc.cluster.local:8080", "tracker.plant.example.org."):
                assert status_for(address, path, host) == 200, (path, host)


@pytest.mark.parametrize("sent", [b"", b"GET /healthz HTTP/1.1\r\nhost: a\r\n"])
def test_connections_without_a_request_keep_no_probe_out(sent: bytes) -> None:
    """However many connections send nothing, or half a request, `/healthz` says 200; in the end they are closed."""
    with served(Watched(), http_hosts=["tracker.example.org"]) as address, contextlib.ExitStack() as stack:
        host, _, port = address.rpartition(":")
        idle = [stack.enter_context(socket.create_connection((host, int(port)))) for _ in range(2 * CONNECTIONS)]
        for one in idle:
            with contextlib.suppress(OSError):  # it had to make room
                one.sendall(sent)
        assert get(address, "/healthz")[0] == 200
        for one in idle:
            one.settimeout(END_S)
            with contextlib.suppress(ConnectionResetError):
                assert one.recv(1) == b""


def test_websockets_keep_no_probe_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """They count among the connections: where all places are theirs, the one that is open for longest makes room."""
    monkeypatch.setattr(server, "CONNECTIONS", 8)
    with served(Watched(), http_clients=64) as address, contextlib.ExitStack() as stack:
        url = f"ws://{address}/api/v1/ws?stream={STREAM}"
        sockets = [create_connection(url, timeout=60, suppress_origin=True) for _ in range(20)]
        for one in sockets:
            stack.callback(one.shutdown)
        assert get(address, "/healthz")[0] == 200
        sockets[-1].ping()
        with pytest.raises((WebSocketException, OSError)):
            sockets[0].recv()


@pytest.mark.parametrize("path", ["ws?stream=a/b/c", "detections?stream=a/b/c"])
@pytest.mark.parametrize("frames", [b"\x00\x81" + bytes(4) + b"a", b"\x89\x80" + bytes(4)], ids=["pieces", "pings"])
def test_messages_in_pieces_hold_no_loop(path: str, frames: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six clients send pieces of a byte, or pings, without end: a turn of the loop reads a few, and they are closed."""
    sizes: list[int] = []
    receive = WSConnection.receive_data

    def received(self: WSConnection, data: bytes) -> None:
        sizes.append(len(data))
        receive(self, data)

    monkeypatch.setattr(WSConnection, "receive_data", received)
    data = b"\x01\x81" + bytes(4) + b"a" + frames * 300_000
    with Edge(free_endpoint(), router=True) as edge, ThreadPoolExecutor(6) as pool:
        url = f"ws://{edge.address}/api/v1/{path}"
        sockets = [create_connection(url, timeout=60, suppress_origin=True) for _ in range(6)]
        sending = [pool.submit(send_all, one.sock, data) for one in sockets]
        assert get(edge.address, "/healthz")[0] == 200
        for one in sockets:
            while (found := one.recv_frame()).opcode != ABNF.OPCODE_CLOSE:  # an answer could find it closed
                pass
            assert int.from_bytes(found.data[:2], "big") == 1008
            one.shutdown()
        wait(sending, timeout=60)
    assert max(sizes) <= SLICE
    assert sum(sizes) < 6 * 10 * SLICE


def test_a_body_in_tiny_chunks_holds_no_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six clients send theirs in chunks of a byte: a turn of the loop reads a few, and all are taken in the end."""
    sizes: list[int] = []
    receive = h11.Connection.receive_data

    def received(self: h11.Connection, data: bytes) -> None:
        sizes.append(len(data))
        receive(self, data)

    monkeypatch.setattr(h11.Connection, "receive_data", received)
    text = b'{"objects": []}' + b" " * 20_000
    chunks = b"".join(b"1\r\n%b\r\n" % text[at : at + 1] for at in range(len(text))) + b"0\r\n\r\n"
    with Edge(free_endpoint(), router=True) as edge, ThreadPoolExecutor(6) as pool:
        host, _, port = edge.address.rpartition(":")
        head = f"POST /api/v1/detections?stream=a/b/c HTTP/1.1\r\nhost: {edge.address}\r\nconnection: close\r\n"
        head += "content-type: application/json\r\ntransfer-encoding: chunked\r\n\r\n"

        def send(_number: int) -> bytes:
            with socket.create_connection((host, int(port)), 60) as connection:
                connection.sendall(head.encode() + chunks)
                return connection.recv(1000)

        answers = pool.map(send, range(6))
        assert get(edge.address, "/healthz")[0] == 200
        assert all(one.startswith(b"HTTP/1.1 202 ") for one in answers)
    assert max(sizes) <= SLICE
    assert sum(size > CHUNKED_SLICE for size in sizes) <= 6 + 1, "of each the first part, which has the head"


def test_a_large_message_in_usual_pieces_is_taken() -> None:
    """Of a kilobyte, and pings between them; many small messages at once are answered one by one."""
    with Edge(free_endpoint(), router=True) as edge:
        url = f"ws://{edge.address}/api/v1/detections?stream=site/node/lidar"
        with closing(create_connection(url, timeout=60, suppress_origin=True)) as sender:
            text = json.dumps({"objects": []}).encode() + b" " * 600_000
            starts = range(0, len(text), 1000)
            for at in starts:
                sender.send_frame(ABNF(at == starts[-1], 0, 0, 0, 0 if at else 1, 1, text[at : at + 1000]))
                if at % 100_000 == 0:
                    sender.ping()
            assert json.loads(sender.recv())["index"] == 0
            for _ in range(300):
                sender.send(json.dumps({"objects": []}))
            found = [json.loads(sender.recv()) for _ in range(300)]
            assert [one["index"] for one in found] == list(range(1, 301))


def send_all(connection: socket.socket, data: bytes) -> None:
    with contextlib.suppress(OSError):
        connection.sendall(data)


def test_slow_requests_keep_no_probe_out() -> None:
    """While all the requests that are answered at once hang, probes are answered and others refused."""
    gate = threading.Event()
    hanging: list[Future[tuple[int, str]]] = []

    def hang() -> bytes:
        gate.wait(60)
        return b"late 1\n"

    def all_busy() -> bool:
        """Whether a further request is refused; one that took the place of a hanging request is made up for."""
        hanging[:] = [one for one in hanging if not one.done()]
        hanging.extend(pool.submit(get, address, "/metrics") for _ in range(REQUESTS - len(hanging)))
        return (
            status_for(address, "/", "stranger.example.org") == 503
        )  # else 421, which needs no thread, and they all hang

    source = Watched()
    source.metrics = SimpleNamespace(text=hang)
    with served(source) as address, ThreadPoolExecutor(REQUESTS) as pool:
        try:
            until(all_busy, "all are busy")
            assert get(address, "/healthz")[0] == get(address, "/readyz")[0] == 200
        finally:
            gate.set()
        ended = [one.result(60)[0] for one in hanging]
        assert ended.count(200) >= REQUESTS - 1, "the place of one may still have been that of the last question"


@pytest.mark.parametrize("state", ["starting", "stopping"])
def test_readiness_follows_the_state(state: str) -> None:
    """`/readyz` says 200 when the service can be used, 503 with the state before and after."""
    source = Watched()
    with served(source) as address:
        assert get(address, "/readyz") == (200, '{"ready":true,"state":"ready"}')
        source.why = "disk full"
        assert get(address, "/readyz") == (200, '{"ready":true,"state":"ready","failure":"disk full"}')
        source.why = ""
        source.now = state
        assert get(address, "/readyz") == (503, f'{{"ready":false,"state":"{state}"}}')
        assert get(address, "/healthz")[0] == 200


def test_what_nobody_serves_is_not_found() -> None:
    """The page and the metrics are served at their paths; any other is 404."""
    with served(Watched(), http_hosts=["tracker.example.org"]) as address:
        assert get(address, "/")[1].startswith("<!")
        assert get(address, "/metrics") == (200, "one 1\n")
        assert json.loads(get(address, "/api/v1/asyncapi.json")[1])["asyncapi"] == "3.0.0"
        assert get(address, "/nothing")[0] == 404


@pytest.mark.parametrize(
    ("method", "path", "headers", "status", "code"),
    [
        ("GET", "/api/v1/track", {}, 404, "not_found"),
        ("PUT", "/api/v1/detections", {}, 405, "method_not_allowed"),
        ("POST", "/api/v1/tracks", {}, 405, "method_not_allowed"),
        ("GET", "/api/v1/tracks", {}, 400, "missing_field"),
        ("GET", "/api/v1/streams", {"host": "stranger.example.org"}, 421, "unknown_host"),
        ("POST", "/api/v1/detections", {"origin": "https://stranger.example"}, 403, "other_origin"),
        ("POST", "/api/v1/detections", {"content-type": "text/plain"}, 415, "wrong_type"),
    ],
)
def test_what_is_refused_has_one_shape(method: str, path: str, headers: dict[str, str], status: int, code: str) -> None:
    """A code, a path and a message; where nothing is, the paths and the methods that there are."""
    with Edge(free_endpoint(), router=True) as edge, asked(edge.address, path, method, **headers) as response:
        assert response.status == status
        error = json.loads(response.read())["error"]
        assert (error["code"], isinstance(error["path"], str), bool(error["message"])) == (code, True, True)
        if status in {404, 405}:
            assert error["paths"]["/api/v1/detections"] == ["POST"]
            assert error["paths"]["/api/v1/tracks"] == ["GET", "HEAD"]
            assert (response.headers["allow"] is not None) is (status == 405)


def test_an_address_in_use_is_one_error() -> None:
    """A port that somebody listens on gives one line that names the address."""
    source: Any = Watched()
    served_here = application(source, Settings())
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ClientError, match=f"cannot listen on {address} for HTTP: Address already in use"):
            Server(served_here, address, 4096)
        with ServiceProcess("--http", address) as service:
            assert service.wait_end() == 1
            assert service.errors.splitlines()[-1].startswith("optipmb-service: cannot listen on")


def test_a_service_tells_how_it_is_from_its_start_to_its_end() -> None:
    """Alive but not ready while it waits for a router, ready with one; a signal ends it despite open connections."""
    endpoint = free_endpoint()
    options = ("--connect", endpoint, "--http", "127.0.0.1:0", "--log-format", "json")
    with ServiceProcess(*options, listen=False) as service:
        address = address_of(service)
        service.wait_log("connecting")
        assert get(address, "/healthz")[0] == 200
        assert get(address, "/readyz") == (503, '{"ready":false,"state":"starting"}')
        with open_router(endpoint):
            service.wait_ready()
            until(lambda: get(address, "/readyz")[0] == 200, "ready")
            interface = json.loads(get(address, "/api/v1/asyncapi.json")[1])
            assert interface["servers"]["router"]["host"] == endpoint.partition("/")[2]
            host, _, port = address.rpartition(":")
            with socket.create_connection((host, int(port))):
                status, _ = service.end(signal.SIGTERM)
        assert status == 0
        assert "Traceback" not in service.errors


def test_metrics_count_what_happened(tmp_path: Path) -> None:
    """Every metric of a service is there, in Prometheus' format, with the figures of sent frames; also over Zenoh."""
    options = ("--http", "127.0.0.1:0", "--log-format", "json", "--instance", "one")
    environment = {"OPTIPMB_STORE": str(tmp_path), "OPTIPMB_CHECKPOINT_S": "0.1"}
    with ServiceProcess(*options, environment=environment) as service:
        address = address_of(service)
        service.wait_ready()
        with Node(service.endpoint) as node:
            frames = [SENSOR.detections(seq) for seq in range(6)]
            node.send(*frames, frames[5])  # the last one twice
            node.send_raw(KEYS.detections(SENSOR.stream), b"garbage")
            node.tracks(SENSOR.stream, 6)
            node.problem(SENSOR.stream, "malformed")
            until(lambda: samples(get(address, "/metrics")[1])[f"{NAMESPACE}checkpoints_total", ()] > 0, "a checkpoint")
            figures = samples(get(address, "/metrics")[1])
            ((ok, key, asked),) = node.query(KEYS.metrics("one"))
            status = node.ask(KEYS.status("one"), ServiceStatus)
        assert {name.removesuffix("_bucket") for name, _ in figures if name.startswith(NAMESPACE)} >= {
            NAMESPACE + name for name, metric in SERVICE_METRICS.items() if metric.kind != "histogram"
        }
        expected = {
            ("frames_total", ()): 6,
            ("received_total", (("topic", "detections"),)): 8,
            ("dropped_total", (("reason", "duplicate"),)): 1,
            ("dropped_total", (("reason", "refused"),)): 1,
            ("dropped_total", (("reason", "late"),)): 0,
            ("problems_total", (("code", "malformed"),)): 1,
            ("sessions", (("state", "running"),)): 1,
            ("streams", (("role", "owner"),)): 1,
            ("streams", (("role", "standby"),)): 0,
            ("sessions_restored_total", ()): 0,
            ("tracks", ()): status.sessions[0].tracks,
            ("latency_seconds_count", ()): 6,
            ("step_seconds_count", ()): 6,
            ("state", (("state", "ready"),)): 1,
            ("state", (("state", "starting"),)): 0,
            ("stream_frames_total", (("stream", SENSOR.stream),)): 6,
            ("streams_unlisted", ()): 0,
        }
        assert {key: figures[NAMESPACE + key[0], key[1]] for key in expected} == expected
        started, ended = (figures[f"{NAMESPACE}tracks_{what}_total", ()] for what in ("started", "ended"))
        assert started - ended == figures[f"{NAMESPACE}tracks", ()] > 0
        assert 0 <= figures[f"{NAMESPACE}checkpoint_age_seconds", ()] < 10
        assert figures["process_resident_memory_bytes", ()] > 1e7
        assert (ok, key) == (True, KEYS.metrics("one"))
        same = samples(asked.decode())
        assert {name for name in figures if name not in same} == set()
        assert same[f"{NAMESPACE}frames_total", ()] == 6


def test_viewers_use_up_no_keys() -> None:
    """Repeated readers of a stream use two keys, and one for links; a reader of ever new streams has to wait."""
    with ServiceProcess("--http", "127.0.0.1:0", "--log-format", "json") as service:
        address = address_of(service)
        service.wait_ready()
        host, _, port = address.rpartition(":")

        def declared() -> float:
            return samples(get(address, "/metrics")[1])[f"{NAMESPACE}declared_keys_total", ()]

        def look(stream: str) -> int:
            with contextlib.closing(http.client.HTTPConnection(host, int(port), timeout=60)) as connection:
                connection.request("GET", f"/live?stream={stream}")
                with connection.getresponse() as response:
                    return response.status

        before = declared()
        for _ in range(100):
            until(lambda: look("a/b/c") == http.client.OK, "a viewer is let in")
        assert declared() == before + 3
        refused = http.client.SERVICE_UNAVAILABLE
        until(lambda: look(f"a/b/stream-{next(NUMBERS)}") == refused, "no more streams are subscribed to")
        assert declared() <= before + BURST + 20
        assert look("a/b/c") in {http.client.OK, refused}
        assert get(address, "/healthz")[0] == 200


def test_series_of_streams_are_bounded_and_figures_outlive_sessions() -> None:
    """Only so many streams have series, which go with the sessions; counters never fall when sessions end."""
    options = ("--http", "127.0.0.1:0", "--log-format", "json")
    with ServiceProcess(*options, environment={"OPTIPMB_HTTP_STREAMS": "2"}) as service:
        address = address_of(service)
        service.wait_ready()
        streams = [f"site/node/lidar-{number}" for number in range(5)]
        with Node(service.endpoint) as node:
            for stream in streams:
                node.send(*(Sensor(stream).detections(seq) for seq in range(5)))
            for stream in streams:
                node.tracks(stream, 5)
            busy = samples(get(address, "/metrics")[1])
            for stream in streams:
                assert node.query(KEYS.query(stream, "reset"), json.dumps({"close": True}).encode())[0][0]
            ended = samples(get(address, "/metrics")[1])

    def listed(figures: Samples) -> set[tuple[tuple[str, str], ...]]:
        return {labels for name, labels in figures if name == f"{NAMESPACE}stream_frames_total"}

    assert listed(busy) == {(("stream", stream),) for stream in streams[:2]}
    assert listed(ended) == set()
    assert busy[f"{NAMESPACE}streams_unlisted", ()] == 3
    assert busy[f"{NAMESPACE}tracks", ()] > ended[f"{NAMESPACE}tracks", ()] == 0
    for figures in (busy, ended):
        assert figures[f"{NAMESPACE}frames_total", ()] == 25
    assert ended[f"{NAMESPACE}tracks_started_total", ()] == ended[f"{NAMESPACE}tracks_ended_total", ()] > 0


def test_the_health_command() -> None:
    """`optipmb-service health` ends with 0 when the service is well, 1 when it is not there, 2 without an address."""

    def health(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "optipmb_service", "health", *options]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    source = Watched()
    source.now = "starting"
    with served(source) as address:
        well = health("--http", address)
        assert (well.returncode, json.loads(well.stdout)) == (0, {"alive": True, "beat_age_s": 0.1})
        assert health("--http", address, "--ready").returncode == 1
    gone = health("--http", address)
    assert (gone.returncode, gone.stdout) == (1, f"no answer at {address}: [Errno 111] Connection refused\n")
    assert health().returncode == 2


def test_a_server_that_ends_later_than_it_may_ends_well(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its thread still has its socket after the wait for it ended: else it would end with an exception."""
    one = Server(application(Watched(), Settings(), None), "127.0.0.1:0", 1000)
    threads = [thread for thread in threading.enumerate() if thread.name == "http"]
    monkeypatch.setattr(server, "GRACE_S", 0)
    one.close()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
