"""How calls end: by their callers, by deadlines, by silence; the metrics say how, and nothing is left of them."""

import re
import socket
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from gateway import GatewayProcess, detections, frame
from optipmb_schemas.protobuf import tracking_pb2 as pb
from routers import free_endpoint
from service_process import ServiceProcess

WAIT_S = 60.0
CALLS = 50
ROUNDS = 8


@pytest.fixture(scope="module")
def metered(service: ServiceProcess) -> Iterator[tuple[GatewayProcess, str]]:
    """A gateway that serves its metrics, and their address."""
    address = free_endpoint().removeprefix("tcp/")
    with GatewayProcess(service.endpoint, "--http", address) as process:
        process.wait_ready()
        yield process, f"http://{address}/metrics"


@pytest.fixture(scope="module", autouse=True)
def slow(metered: tuple[GatewayProcess, str]) -> Iterator[socket.socket]:
    """A connection that begins and says no more; opened first, because it takes its time to be cut off."""
    host, _, port = metered[0].address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=WAIT_S) as begun:
        begun.sendall(b"PRI * HTTP/2.0\r\n")
        yield begun


def counts(address: str) -> dict[str, float]:
    """The metrics of the gateway by name and labels, as `grpc_calls_total{method="Track",code="OK"}`."""
    with urllib.request.urlopen(address, timeout=10) as answer:  # noqa: S310 - the gateway's own address
        text = answer.read().decode()
    return {key: float(value) for key, value in re.findall(r"^optipmb_(grpc_\S+) (\S+)$", text, re.MULTILINE)}


def wait_for(condition: Callable[[], bool], what: str) -> None:
    ends = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < ends, what
        time.sleep(0.05)


def labelled(method: str, **labels: str) -> str:
    """The labels of a metric, in the order of the exposition."""
    return "{" + ",".join(f'{name}="{value}"' for name, value in sorted(({"method": method} | labels).items())) + "}"


def test_metrics_count_calls_and_messages_by_method(metered: tuple[GatewayProcess, str], stream: str) -> None:
    """Requests, responses and ends of a call are counted under its method, refused values under their code."""
    gateway, address = metered
    bad = detections(frame(3, stream))
    bad.detections.score.data = bytes(8 * [0x7F])  # of one row, where there are two
    before = counts(address)
    list(gateway.stub().Track(iter([*(detections(frame(seq, stream)) for seq in range(3)), bad])))
    told = {key: value - before.get(key, 0) for key, value in counts(address).items()}
    assert told["grpc_requests_total" + labelled("Track")] == 4
    assert told["grpc_responses_total" + labelled("Track")] == 4
    assert told["grpc_calls_total" + labelled("Track", code="OK")] == 1
    assert told["grpc_open_calls" + labelled("Track")] == 0
    assert sum(value for key, value in told.items() if key.startswith("grpc_refused_total")) == 1


def test_calls_that_come_again_use_up_no_keys(metered: tuple[GatewayProcess, str], stream: str) -> None:
    """Repeated calls for one stream declare no keys beyond the first call's."""
    gateway, address = metered
    stub: Any = gateway.stub()

    def declared() -> float:
        with urllib.request.urlopen(address, timeout=10) as answer:  # noqa: S310 - the gateway's own address
            return float(re.findall(r"^optipmb_declared_keys_total (\S+)$", answer.read().decode(), re.MULTILINE)[0])

    def round_of_calls(number: int) -> None:
        responses = list(stub.Track((detections(frame(seq + 5 * number, stream)) for seq in range(5)), timeout=60))
        assert len(responses) == 5
        list(stub.Publish(iter([detections(frame(5 * number, f"{stream}-2"), pb.PublishRequest)]), timeout=60))
        watching = stub.Subscribe(pb.SubscribeRequest(pattern="*/*/*", problems=True), timeout=60)
        watching.initial_metadata()
        watching.cancel()
        wait_for(lambda: not any(value for key, value in counts(address).items() if "open_calls" in key), "open calls")

    before = declared()
    round_of_calls(0)
    first = declared()
    assert first > before
    for number in range(1, 10):
        round_of_calls(number)
    assert declared() == first


def test_calls_that_are_cancelled_or_late_leave_nothing(metered: tuple[GatewayProcess, str], stream: str) -> None:
    """Their subscriptions and publishers are withdrawn, so that threads and open calls are as before."""
    gateway, address = metered
    stub: Any = gateway.stub()
    threads = Path(f"/proc/{gateway.process.pid}/task")

    def round_of_calls(number: int) -> None:
        cancelled = [stub.Subscribe(pb.SubscribeRequest(pattern=f"{stream}{one}")) for one in range(number)]
        late = [stub.Subscribe(pb.SubscribeRequest(pattern=stream), timeout=0.5) for _ in range(number)]
        for one in cancelled:
            one.initial_metadata()
            one.cancel()
        for one in late:
            with pytest.raises(grpc.RpcError) as raised:
                list(one)
            assert raised.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
        wait_for(lambda: counts(address)["grpc_open_calls" + labelled("Subscribe")] == 0, "calls are open")

    # Threads that wait for blocking work come to stay, as many as there may be of them; each round may bring some.
    left: list[int] = []
    while len(left) < 2 or (left[-1] > left[-2] and len(left) < ROUNDS):
        round_of_calls(CALLS)
        left.append(len(list(threads.iterdir())))
    assert left[-1] <= left[-2], f"threads after each round: {left}"
    assert (
        counts(address)["grpc_calls_total" + labelled("Subscribe", code="CANCELLED")] >= 2 * CALLS
    )  # a late one may not have begun


def test_a_client_that_begins_too_slowly_is_cut_off(slow: socket.socket) -> None:
    """Who does not finish the beginning of a connection within ten seconds loses it."""
    while slow.recv(4096):
        pass
