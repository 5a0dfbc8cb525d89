"""Output at a fixed rate of a real service: over Zenoh, gRPC and WebSocket, and of the next owner after a kill."""

import contextlib
import itertools
import json
import re
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fleet import RouterProcess
from gateway import GatewayProcess
from optipmb_client import Subscriber
from optipmb_schemas import Tracks
from readers import received
from router import Node, Sensor, until
from service_process import ServiceProcess
from websocket import create_connection

RATE_HZ = 20
OUTPUTS = {"OPTIPMB_OUTPUTS": json.dumps({"garage/*/*": {"rate_hz": RATE_HZ}})}
STREAM = "garage/node/lidar"


@contextlib.contextmanager
def driving(endpoint: str) -> Iterator[None]:
    """Publish frames with stamps of the system's clock, ten a second."""
    ended = threading.Event()

    def publish() -> None:
        sensor = Sensor(STREAM)
        with Node(endpoint) as node:
            for seq in range(10_000):
                node.send(sensor.detections(seq, stamp_ns=time.time_ns()))
                if ended.wait(0.1):
                    return

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(60)


def check(messages: list[Tracks]) -> None:
    """Messages of one owner are predicted beyond their frames, each to a later time."""
    times = [one.predicted_to_ns or 0 for one in messages]
    assert times == sorted(times)
    assert all(one.predicted_to_ns is not None and one.predicted_to_ns > one.stamp_ns for one in messages)
    assert len({one.seq for one in messages}) < len(messages), "there is output between frames"


@pytest.mark.parametrize("edge", ["zenoh", "grpc"])
def test_python_reads_predicted_tracks(edge: str) -> None:
    """A subscriber gets each message, also several of one frame."""
    with ServiceProcess(environment=OUTPUTS) as service:
        service.wait_ready()
        with GatewayProcess(service.endpoint) as gateway, driving(service.endpoint):
            gateway.wait_ready()
            where = service.endpoint if edge == "zenoh" else f"grpc://{gateway.address}"
            with Subscriber("garage/*/*", where, predict=True, timeout=60) as tracks:
                check([one for one, _ in zip(tracks, range(40), strict=False)])
            assert tracks.statistics.repeated == 0


def test_a_websocket_gives_predicted_tracks() -> None:
    """With `predict`, as fast as is asked for; the newest frame of a GET is none of these."""
    with ServiceProcess("--http", "127.0.0.1:0", "--log-format", "json", environment=OUTPUTS) as service:
        service.wait_ready()
        address = re.findall(r'"http", .*?"address": "([^"]+)"|"address": "([^"]+)"', service.errors)[0][1]
        url = f"ws://{address}/api/v1/ws?stream=garage/*/*&predict=1&max_rate_hz=5"
        socket = create_connection(url, timeout=60, suppress_origin=True)
        with contextlib.closing(socket), driving(service.endpoint):
            texts = [json.loads(received(socket)) for _ in range(8)]
    times = [int(one["predicted_to_ns"]) for one in texts]
    assert all(later - earlier >= 0.95e9 / 5 for earlier, later in itertools.pairwise(times))
    assert all(int(one["stamp_ns"]) < at for one, at in zip(texts, times, strict=True))


def test_the_next_owner_goes_on(tmp_path: Path) -> None:
    """Output stops with an owner that is killed, and is the other one's after the lease."""
    environment = OUTPUTS | {"OPTIPMB_STORE": str(tmp_path), "OPTIPMB_LEASE_S": "1"}
    with RouterProcess() as router, contextlib.ExitStack() as stack:
        options = ("--connect", router.endpoint)
        first, second = (
            stack.enter_context(ServiceProcess(*options, "--instance", name, environment=environment, listen=False))
            for name in ("first", "second")
        )
        for one in (first, second):
            one.wait_ready()
            one.wait_log("held=32")
        received: list[Tracks] = []
        subscriber = stack.enter_context(Subscriber(STREAM, router.endpoint, predict=True))
        reader = threading.Thread(target=lambda: received.extend(subscriber), daemon=True)
        reader.start()
        with driving(router.endpoint):
            until(lambda: len(received) > RATE_HZ, "the output of the first owner")
            (owner,) = {one.delivery.instance for one in received if one.delivery}
            services = {"first": first, "second": second}
            services.pop(owner).process.send_signal(signal.SIGKILL)
            (other,) = services

            def of_other() -> list[Tracks]:
                return [one for one in tuple(received) if one.delivery and one.delivery.instance == other]

            until(lambda: len(of_other()) > RATE_HZ, "the output of the next owner")
        check(of_other())
        instances = [one.delivery.instance for one in received if one.delivery]
        assert instances == sorted(instances, key=[owner, other].index), "never both"
