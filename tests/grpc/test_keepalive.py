"""A connection that says nothing any more, and was not closed, is found by its pings."""

from __future__ import annotations

import itertools
import signal
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest
from gateway import GatewayProcess, connected
from optipmb_client import Publisher, Subscriber
from service_process import ServiceProcess

DEADLINE_S = 50.0
"""Pings find it in 15 s on the client's side and in 30 s on the gateway's; all other limits are a minute and more."""

ACKNOWLEDGED = bytes([0, 0, 0, 4, 1, 0, 0, 0, 0])
"""What a client says to the settings of a server."""

CAR: Any = {"label": ["car"], "center": [[1, 2, 0.8]], "size": [[4.5, 1.9, 1.6]], "yaw": [0.5], "score": [0.9]}


@pytest.fixture(scope="module")
def silent(gateway: GatewayProcess) -> Iterator[tuple[socket.socket, float]]:
    """A connection whose client says nothing after the handshake, and when it began: before the other test."""
    with connected(gateway) as one:
        one.sendall(ACKNOWLEDGED)
        yield one, time.monotonic()


@pytest.mark.usefixtures("silent")
def test_a_gateway_that_hangs(service: ServiceProcess, gateway: GatewayProcess, stream: str) -> None:
    """A client leaves it for the next one: tracks come again."""
    with GatewayProcess(service.endpoint) as hanging:
        hanging.wait_ready()
        both = [f"grpc://{one.address}" for one in (hanging, gateway)]
        with (
            Publisher(stream, both[1], frame="world") as publisher,
            Subscriber(stream, both) as subscriber,
        ):
            seqs = itertools.count()
            assert arrives(publisher, subscriber, seqs)
            hanging.process.send_signal(signal.SIGSTOP)
            try:
                while subscriber.receive(0.5) is not None:
                    pass  # messages on their way
                assert arrives(publisher, subscriber, seqs)
            finally:
                hanging.process.send_signal(signal.SIGCONT)


def arrives(publisher: Publisher, subscriber: Subscriber, seqs: itertools.count[int]) -> bool:
    """Publish ten frames a second until the tracks of one are here."""
    ends = time.monotonic() + DEADLINE_S
    for seq in seqs:
        publisher.publish(stamp_ns=10**18 + seq * 10**8, **CAR)
        if subscriber.receive(0.1) is not None:
            return True
        if time.monotonic() > ends:
            break
    return False


def test_a_client_that_hangs(silent: tuple[socket.socket, float]) -> None:
    """A gateway closes the connection of a client that answers no ping."""
    one, began = silent
    one.settimeout(max(1.0, began + DEADLINE_S - time.monotonic()))
    while one.recv(4096):
        pass
