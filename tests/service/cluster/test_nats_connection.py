"""The connection to NATS servers that go and come."""

import gc
from pathlib import Path

from nats_process import NatsProcess
from optipmb_service.cluster.nats_connection import NatsConnection
from proxy import Proxy
from router import until


def test_connections_that_are_ended_before_the_greeting_are_closed(tmp_path: Path) -> None:
    """While a server starts, or the way to it is open at one end only, no connection is left open: none is warned of.

    The address takes connections and ends them at once, until the server behind it is back.
    """
    with NatsProcess(tmp_path) as server, Proxy(server.address) as proxy:
        connection = NatsConnection([f"nats://{proxy.address}"])
        until(lambda: not connection.failure, "a connection")
        server.kill()
        before = proxy.accepted
        until(lambda: proxy.accepted >= before + 3, "tries to connect")
        server.start()
        until(lambda: not connection.failure, "a connection again")
        gc.collect()
        connection.close(5.0)
        gc.collect()
